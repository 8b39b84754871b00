"""Absolute checks of a calibration: figures beside limits that do not come from the same fit.

A check that fails refuses the part that it is about; one that is doubtful is said beside the result. Each names its
part and its numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Part = Literal["intrinsics", "hand_eye", "light_plane"]
Verdict = Literal["ok", "doubt", "refused"]


@dataclass(frozen=True)
class QualityCheck:
    """One figure beside the value from which it is doubtful and that from which the part is refused."""

    part: Part
    name: str
    value: float
    doubt: float
    refuse: float
    unit: str
    says: str
    """What is the matter when it is not well, with the numbers and what to do."""

    @property
    def verdict(self) -> Verdict:
        """What the figure says; one that is not a number is refused."""
        if not self.value < self.refuse:
            return "refused"
        return "ok" if self.value < self.doubt else "doubt"

    @property
    def text(self) -> str:
        """The words for people; empty when all is well."""
        if self.verdict == "ok":
            return ""
        limit = self.refuse if self.verdict == "refused" else self.doubt
        unit = f" {self.unit}" if self.unit else ""
        figure = (
            f"{self.value:.3g}{unit}, {'allowed' if self.verdict == 'refused' else 'usual'} below {limit:.3g}{unit}"
        )
        return f"{self.part.replace('_', '-')}: {self.name} is {figure}: {self.says}"

    def as_dict(self) -> dict[str, object]:
        """For the JSON."""
        return {
            "part": self.part,
            "name": self.name,
            "value": self.value if abs(self.value) < float("inf") else None,
            "doubt_from": self.doubt,
            "refused_from": self.refuse if self.refuse < float("inf") else None,
            "unit": self.unit,
            "verdict": self.verdict,
            "text": self.text,
        }


def refused_parts(checks: Iterable[QualityCheck]) -> dict[str, list[QualityCheck]]:
    """The checks that fail, by part."""
    found: dict[str, list[QualityCheck]] = {}
    for check in checks:
        if check.verdict == "refused":
            found.setdefault(check.part, []).append(check)
    return found
