"""How good is the cell today, and until when? What its jobs have seen of its parts since the calibration.

Every job looks: at the fine board for the scan head's mount, at the plate on the claw for the laser and for the head on
its rail. So each part has a series of figures, and a series shows what creeps.
"""

from __future__ import annotations

import datetime as dt
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.measure.calibration.drift.reference_plate import LARGEST_RAD
from cell.measure.calibration.drift.slip import LARGEST_M
from cell.procedures.calibrate.interim import MOVED
from cell.run.folder import Report, list_runs, read_report
from drivers.errors import CellError

Array = NDArray[np.float64]

FOR_A_TREND = 5
"""Jobs that a trend needs at least."""
CLEARLY = 4.0
"""Standard deviations by which a trend must differ from none."""
DAY_S = 86_400.0
FAR_DAYS = 3_650.0
"""Days beyond which nobody waits for a limit to be reached."""


@dataclass(frozen=True, eq=False)
class DriftSeries:
    """What jobs have seen of one part since the calibration, oldest first.

    `days` (n,) since the first of them; `values` (n, k) in `unit`, as far as the part is from where it was calibrated;
    `limit` is what their length may reach: beyond it a job is refused.
    """

    part: str
    unit: str
    days: Array
    values: Array
    limit: float

    @cached_property
    def _line(self) -> tuple[Array, Array, float]:
        """Where the line through the values is on the last day (k,), its slope a day (k,), and that one's σ."""
        ago = self.days - self.days[-1]
        if len(ago) < FOR_A_TREND or np.ptp(ago) == 0.0:
            return self.values.mean(axis=0), np.zeros(self.values.shape[1]), np.inf
        away = ago - ago.mean()
        slope = away @ self.values / (away @ away)
        now = self.values.mean(axis=0) - slope * ago.mean()
        left = self.values - now - ago[:, None] * slope
        spread = float(np.sqrt(np.sum(left**2) / (self.values.shape[1] * (len(ago) - 2))))
        return now, slope, max(spread, 1e-9) / float(np.sqrt(away @ away))

    @property
    def now(self) -> float:
        """How far off it is after the last job: by the line through all of them, on average where there is none."""
        return float(np.linalg.norm(self._line[0] if self.creeps else self.values.mean(axis=0)))

    @property
    def last(self) -> float:
        """What the last job saw."""
        return float(np.linalg.norm(self.values[-1]))

    @property
    def creeps(self) -> bool:
        """Whether there is a trend that chance does not bring."""
        _, slope, sigma = self._line
        return bool(np.linalg.norm(slope) > CLEARLY * sigma)

    @property
    def a_day(self) -> float:
        """How fast it creeps, `unit` a day; 0 where it does not."""
        return float(np.linalg.norm(self._line[1])) if self.creeps else 0.0

    @property
    def days_left(self) -> float | None:
        """In how many days the limit is reached, 0 where it is; None where that is not in sight."""
        if self.now >= self.limit:
            return 0.0
        if not self.creeps:
            return None
        now, slope, _ = self._line
        # The line leaves the ball of the limit at one time after now.
        half, square = float(now @ slope), float(slope @ slope)
        days = (-half + np.sqrt(half**2 + square * (self.limit**2 - float(now @ now)))) / square
        return float(days) if days < FAR_DAYS else None

    def as_dict(self) -> dict[str, object]:
        """For people and programs."""
        days = self.days_left
        return {
            "part": self.part, "unit": self.unit, "jobs": len(self.days), "last": round(self.last, 4),
            "now": round(self.now, 4), "limit": self.limit, "a_day": round(self.a_day, 5),
            "days_left": None if days is None else round(days, 1),
            "values": [round(float(np.linalg.norm(value)), 4) for value in self.values],
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class CellHealth:
    """What the jobs since the newest calibration have seen. `calibrated` is its date, "" where no job has run.

    `jobs` says how many ran since, `unlooked` how many of them did not look at the fine board. `shocks` are the ends
    since then after which parts may sit elsewhere: run and reason. `moved` is the newest run that was refused because
    something has moved, "" without one.
    """

    calibrated: str
    jobs: int
    unlooked: int
    series: tuple[DriftSeries, ...]
    shocks: tuple[tuple[str, str], ...]
    moved: str
    age_days: float
    max_age_days: float

    @property
    def days_left(self) -> float:
        """In how many days a calibration is due."""
        left = [days for one in self.series if (days := one.days_left) is not None]
        return 0.0 if self.moved else max(0.0, min([self.max_age_days - self.age_days, *left]))

    @property
    def due(self) -> str:
        """When a calibration is due, and why, for people."""
        if not self.calibrated:
            return "no job has run yet: nothing is known"
        if self.moved:
            return f"a calibration is due now: run {self.moved} was refused, for something has moved"
        reached = [one for one in self.series if one.days_left == 0.0]
        if reached:
            return f"a calibration is due now: {', '.join(one.part for one in reached)} is beyond its limit"
        first = min(self.series, key=lambda one: np.inf if one.days_left is None else one.days_left, default=None)
        aged = self.max_age_days - self.age_days
        if first is None or first.days_left is None or first.days_left >= aged:
            return f"a calibration is due in {max(0.0, aged):.1f} days, by its age"
        creeps = f"{first.part} creeps {first.a_day:.3f} {first.unit} a day"
        return f"a calibration is due in {first.days_left:.1f} days: {creeps}"

    def as_dict(self) -> dict[str, object]:
        """For people and programs."""
        return {
            "calibrated": self.calibrated, "age_days": round(self.age_days, 2), "max_age_days": self.max_age_days,
            "jobs": self.jobs, "unlooked": self.unlooked, "due": self.due, "days_left": round(self.days_left, 1),
            "parts": [one.as_dict() for one in self.series],
            "moved": self.moved, "shocks": [{"run": run, "reason": reason} for run, reason in self.shocks],
        }  # fmt: skip


def _interim(step: Report) -> tuple[list[float], float] | None:
    found = step.get("interim")
    return None if found is None else (found["off_mm"], found["place_allowed_mm"])


def _slipped(step: Report) -> tuple[list[float], float] | None:
    found = step.get("head_slipped_um")
    return None if found is None else ([1e-3 * value for value in found], 1e3 * LARGEST_M)


def _turned(step: Report) -> tuple[list[float], float] | None:
    found = step.get("laser_turned_mrad")
    # What a verification has seen of it counts no more.
    return None if found is None else ([found - step.get("laser_confirmed_mrad", 0.0)], 1e3 * LARGEST_RAD)


HEAD = "head on the flange"
WATCHED: tuple[tuple[str, str, str, Callable[[Report], tuple[list[float], float] | None]], ...] = (
    (HEAD, "mm", "drive_to_target", _interim),
    ("head on its rail", "mm", "laser_sweep", _slipped),
    ("light plane", "mrad", "laser_sweep", _turned),
)
"""Each part with its unit, the step that looks at it, and what of that step's result it is, with its limit."""


def health(root: Path, max_age_s: float, now: dt.datetime) -> CellHealth:
    """What the runs below `root` tell, with the newest job's calibration, which may be `max_age_s` old."""
    reports = [report for folder in list_runs(root) if (report := _read(folder)) is not None]
    jobs = sorted((report for report in reports if report.get("calibration_date")), key=_begun)
    if not jobs:
        return CellHealth("", 0, 0, (), (), moved="", age_days=0.0, max_age_days=max_age_s / DAY_S)
    calibrated = str(jobs[-1]["calibration_date"])
    since = [report for report in jobs if report["calibration_date"] == calibrated]
    made = dt.datetime.strptime(calibrated, "%Y-%m-%d %H:%M:%S").astimezone()
    series = [made_of for watched in WATCHED if (made_of := _series(since, *watched)) is not None]
    looked = next((len(one.days) for one in series if one.part == HEAD), 0)
    ran = [report for report in since if "drive_to_target" in _steps(report)]
    shocks = [
        (str(report["run"]), str(report["reason"]))
        for report in since
        if str(report.get("code") or "").startswith(("arm.", "collision"))
    ]
    moved = [str(report["run"]) for report in since if _moved(report)]
    return CellHealth(
        calibrated, len(since), len(ran) - looked, tuple(series), tuple(shocks), moved=moved[-1] if moved else "",
        age_days=(now - made).total_seconds() / DAY_S, max_age_days=max_age_s / DAY_S,
    )  # fmt: skip


def _read(folder: Path) -> Report | None:
    try:
        report = read_report(folder)
    except (CellError, OSError):
        return None
    return report if report.get("kind", "job") == "job" else None


def _begun(report: Report) -> float:
    """When it began, s since the epoch."""
    return dt.datetime.strptime(str(report["started"]), "%Y-%m-%dT%H:%M:%S%z").timestamp()


def _moved(report: Report) -> bool:
    """Whether the job was refused because the fine board is not where the calibration has it."""
    return any(number.get("name") == MOVED for number in (report.get("refusal") or {}).get("numbers", ()))


def _steps(report: Report) -> dict[str, Report]:
    """The results of the steps that were done, by name."""
    return {step["name"]: step["result"] for step in report.get("steps") or () if step.get("result")}


def _series(
    reports: Sequence[Report], part: str, unit: str, step: str,
    seen: Callable[[Report], tuple[list[float], float] | None],
) -> DriftSeries | None:  # fmt: skip
    """What these reports tell of a part; None where no job has looked at it."""
    times, values, limits = [], [], []
    for report in reports:
        found = seen(_steps(report).get(step, {}))
        if found is not None:
            times.append(_begun(report))
            values.append(found[0])
            limits.append(found[1])
    if not values:
        return None
    days = (np.array(times) - times[0]) / DAY_S
    return DriftSeries(part, unit, days, np.array(values, dtype=np.float64), limits[-1])


if __name__ == "__main__":
    print(json.dumps(health(Path(sys.argv[1]), float(sys.argv[2]), dt.datetime.now().astimezone()).as_dict()))
