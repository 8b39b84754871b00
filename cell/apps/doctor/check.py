"""One thing about this computer: how it is, whether the cell needs it, and the command that mends it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

State = Literal["ok", "wrong", "not needed"]


@dataclass(frozen=True)
class DoctorCheck:
    """`what` was looked at, what was `found`, and what a person types where it is wrong."""

    what: str
    state: State
    found: str
    mend: str = ""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def judged(what: str, problem: str, found: str, mend: str = "", *, needed: bool = True) -> DoctorCheck:
    """A check that is ok without a `problem`; with one it is wrong where it is `needed`, else told all the same."""
    if not problem:
        return DoctorCheck(what, "ok", found)
    return DoctorCheck(what, "wrong" if needed else "not needed", problem, mend)
