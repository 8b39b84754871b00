"""What a check of the commissioning is, and what it leaves: figures with limits, a verdict, and findings by name.

A check measures. It never compares two files: what it says of the configuration, the devices and the pictures told it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from drivers.interfaces import Reading

if TYPE_CHECKING:
    from cell.apps.commission.workplace import CommissionWorkplace


class CheckVerdict(StrEnum):
    """How a check ended."""

    GOOD = "good"
    WRONG = "wrong"
    """Something was measured that is not as it should be; the findings, or the figures, say what."""
    FAILED = "failed"
    """It could not be measured; the notes say why and what to do."""
    DECLINED = "declined"
    """A person did not want it."""


@dataclass(frozen=True)
class Finding:
    """Something that is not as the configuration has it.

    `name` is its keys in cell.toml; `told` what stands there, `found` what was measured, both in words with units.
    `write` are the keys and the values, as TOML, that would be right; empty where a person has to act. `write_job` are
    the same of the job's file. `remedy` is what to do.
    """

    name: str
    what: str
    told: str
    found: str
    remedy: str
    write: dict[str, str] = field(default_factory=dict)
    write_job: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.name}: {self.what}; configured {self.told}, measured {self.found}. {self.remedy}"


@dataclass
class Result:
    """What a check has found out; filled while it goes on, so that what was measured before a failure is kept."""

    verdict: CheckVerdict = CheckVerdict.GOOD
    readings: list[Reading] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)

    def measure(
        self,
        what: str,
        value: float,
        unit: str,
        *,
        least: float | None = None,
        most: float | None = None,
        remedy: str = "",
    ) -> Reading:
        """Note a figure with its limits; one outside makes the check wrong."""
        reading = Reading(what, float(value), unit, least=least, most=most, remedy=remedy)
        self.readings.append(reading)
        if not reading.ok:
            self.verdict = CheckVerdict.WRONG
            shown = f"{what}: {value:.4g} {unit}".strip() + f", allowed {bounds(reading)} {unit}".rstrip()
            self.notes.append(f"{shown}. {remedy}".strip())
        return reading

    def find(self, finding: Finding) -> None:
        """Note a finding; the check is wrong then."""
        self.findings.append(finding)
        self.verdict = CheckVerdict.WRONG

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "verdict": self.verdict.value,
            "readings": [{**asdict(row), "ok": row.ok} for row in self.readings],
            "findings": [asdict(finding) for finding in self.findings],
            "notes": self.notes,
            "pictures": self.pictures,
        }


@dataclass(frozen=True)
class CommissionCheck:
    """One check: `moves` what, how `far`, how `fast`; `limit` what has to hold; `keys` of the configuration that it
    rests on (tables, or dotted keys); `needs` the checks that have to be good before; `work` does it.

    A check that is not `recorded` begins runs of its own, or stops the cell.
    """

    name: str
    title: str
    moves: str
    far: str
    fast: str
    limit: str
    keys: tuple[str, ...]
    needs: tuple[str, ...]
    work: Callable[[CommissionWorkplace, Result], None]
    recorded: bool = True


def bounds(reading: Reading) -> str:
    """The limits of a figure in words, without its unit."""
    match reading.least, reading.most:
        case None, None:
            return ""
        case None, most:
            return f"≤ {most:g}"
        case least, None:
            return f"≥ {least:g}"
        case least, most:
            return f"{least:g} to {most:g}"
