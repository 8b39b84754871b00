"""How good is the cell today, and until when? What its jobs have seen of its parts since the calibration.

Jobs look at the fine board, which tells of head, joints and board, and at the plate on the claw, which tells of the
laser and of the head on its rail. So each part has a series of figures, and a series shows what creeps.
"""

import datetime as dt
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from cell.config.calibrations.store import name_of, read_calibration
from cell.measure.calibration.drift.reference_plate import LARGEST_RAD
from cell.measure.calibration.drift.slip import LARGEST_M
from cell.procedures.calibrate.interim import MOVED
from cell.run.folder import Report, list_runs, read_report
from drivers.errors import CellError

Array = NDArray[np.float64]

FOR_A_TREND, OVER_DAYS = 5, 1.0
"""Jobs that a trend needs at least, and the time that they must cover: what warms up in an hour does not creep."""
CHANCE = 1e-4
"""Of a trend in what only scatters."""
NEWEST = 3
"""Jobs whose mean tells how far a part is off now, where there is no trend."""
DAY_S = 86_400.0
FAR_DAYS = 3_650.0
"""Days beyond which nobody waits for a limit to be reached."""


@dataclass(frozen=True, eq=False)
class DriftSeries:
    """What jobs have seen of one part since the calibration, oldest first; one job at least.

    `days` (n,) since the first of them; `values` (n, k) in `unit`, as far as the part is from where it was calibrated;
    `limit` is what their length may reach, the smallest of these jobs.
    """

    part: str
    unit: str
    days: Array
    values: Array
    limit: float

    @cached_property
    def _line(self) -> tuple[Array, Array] | None:
        """Where the line through the values is on the last day (k,), and its slope a day (k,); None without a trend.
        There is one where chance would hardly bring it, and where no single step explains the values as well."""
        ago, (jobs, axes) = self.days - self.days[-1], self.values.shape
        if jobs < FOR_A_TREND or np.ptp(ago) < OVER_DAYS:
            return None
        away = ago - ago.mean()
        slope = away @ self.values / (away @ away)
        now = self.values.mean(axis=0) - slope * ago.mean()
        left = float(np.sum((self.values - now - ago[:, None] * slope) ** 2))
        explained, free = float(slope @ slope * (away @ away)), axes * (jobs - 2)
        if explained / axes <= scipy.special.fdtri(axes, free, 1.0 - CHANCE) * left / free or self._step < left:
            return None
        return now, slope

    @property
    def _step(self) -> float:
        """The sum of squares that the best single step leaves."""
        pairs = (np.split(self.values, [k]) for k in range(1, len(self.values)))
        return min(sum(float(np.sum((part - part.mean(axis=0)) ** 2)) for part in pair) for pair in pairs)

    @property
    def now(self) -> float:
        """How far off it is: by the trend where there is one, else the mean of the newest jobs."""
        return float(np.linalg.norm(self._line[0] if self._line else self.values[-NEWEST:].mean(axis=0)))

    @property
    def last(self) -> float:
        """What the last job saw."""
        return float(np.linalg.norm(self.values[-1]))

    @property
    def a_day(self) -> float:
        """How fast it creeps, `unit` a day; 0 where it does not."""
        return float(np.linalg.norm(self._line[1])) if self._line else 0.0

    @property
    def days_left(self) -> float | None:
        """In how many days the limit is reached, 0 where it is; None where that is not in sight."""
        if self.now >= self.limit:
            return 0.0
        if self._line is None:
            return None
        now, slope = self._line
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
            "days_left": None if days is None else round(days, 2),
            "values": [round(float(np.linalg.norm(value)), 4) for value in self.values],
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class CellHealth:
    """What the jobs since a calibration have seen. `calibrated` is its date, "" where no job has run.

    `jobs` of them came to their target, `unlooked` of these did not look at the fine board. `shocks` are the ends since
    then after which parts may sit elsewhere: run and reason. `moved` is the last run that looked, where it was refused
    because something has moved; else "".
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
    def due_now(self) -> bool:
        """Whether nobody should go on without a calibration."""
        return bool(self.calibrated) and self.days_left == 0.0

    @property
    def due(self) -> str:
        """When a calibration is due, and why, for people."""
        if not self.calibrated:
            return "no job has run yet: nothing is known"
        beyond = [one.part for one in self.series if one.days_left == 0.0]
        now = {
            f"run {self.moved} was refused, for something has moved": bool(self.moved),
            f"{', '.join(beyond)} is beyond its limit": bool(beyond),
            f"it is {self.age_days:.0f} days old": self.age_days >= self.max_age_days,
        }
        if why := next((text for text, holds in now.items() if holds), ""):
            return f"a calibration is due now: {why}"
        first = min(self.series, key=lambda one: np.inf if one.days_left is None else one.days_left, default=None)
        if first is None or first.days_left is None or first.days_left >= self.max_age_days - self.age_days:
            return f"a calibration is due in {self.days_left:.1f} days, by its age"
        creeps = f"{first.part} creeps {first.a_day:.3f} {first.unit} a day"
        return f"a calibration is due in {first.days_left:.1f} days: {creeps}"

    def as_dict(self) -> dict[str, object]:
        """For people and programs."""
        return {
            "calibrated": self.calibrated, "age_days": round(self.age_days, 2), "max_age_days": self.max_age_days,
            "jobs": self.jobs, "unlooked": self.unlooked, "due": self.due, "due_now": self.due_now,
            "days_left": round(self.days_left, 2),
            "parts": [one.as_dict() for one in self.series],
            "moved": self.moved, "shocks": [{"run": run, "reason": reason} for run, reason in self.shocks],
        }  # fmt: skip


Seen = tuple[list[float], float] | None
"""How far off a part was, by axis, and what is allowed; None where nobody looked."""


SHARED = "head_looked_s_ago"
"""In the result of a sweep that went by the look for a part before it: what that told counts once."""


def _interim(step: Report) -> Seen:
    found = step.get("interim")
    return None if found is None else (found["off_mm"], found["place_allowed_mm"])


def _slipped(step: Report) -> Seen:
    found = None if step.get(SHARED) else step.get("head_slipped_um")
    return None if found is None else ([1e-3 * value for value in found], 1e3 * LARGEST_M)


def _turned(step: Report) -> Seen:
    found = None if step.get(SHARED) else step.get("laser_turned_mrad")
    # What a verification has seen of it counts no more.
    return None if found is None else ([found - step.get("laser_confirmed_mrad", 0.0)], 1e3 * LARGEST_RAD)


DRIVE = "drive_to_target"
WATCHED: tuple[tuple[str, str, str, Callable[[Report], Seen]], ...] = (
    ("head, joints or board", "mm", DRIVE, _interim),
    ("head on its rail", "mm", "laser_sweep", _slipped),
    ("light plane", "mrad", "laser_sweep", _turned),
)
"""Each part with its unit, the step that looks at it, and what of that step's result it is."""
SHOCKS = ("arm.protective_stop", "arm.not_arrived", "arm.moved_in_sweep", "arm.recovery_mode")
"""Faults after which parts may sit elsewhere."""


def health(root: Path, calibrations: Path, max_age_s: float, now: dt.datetime) -> CellHealth:
    """What the runs below `root` tell of the cell in which the newest job ran, since its newest calibration.

    A calibration in the folder `calibrations` that is newer than that job counts; it may be `max_age_s` old. Reports
    that cannot be read are left out.
    """
    jobs = sorted((report for folder in list_runs(root) if (report := _read(folder)) is not None), key=_begun)
    if not jobs:
        return CellHealth("", 0, 0, (), (), moved="", age_days=0.0, max_age_days=max_age_s / DAY_S)
    newest = jobs[-1]
    calibrated = max(str(newest["calibration_date"]), _stored(root / str(newest["run"]), calibrations))
    since = [report for report in jobs if report["calibration_date"] == calibrated and _cell(report) == _cell(newest)]
    made = dt.datetime.strptime(calibrated, DATE).astimezone()
    series = [made_of for watched in WATCHED if (made_of := _series(since, *watched)) is not None]
    arrived = [steps for report in since if (steps := _steps(report)).get(DRIVE)]
    unlooked = sum("interim" not in steps[DRIVE] and SHARED not in steps.get("laser_sweep", {}) for steps in arrived)
    shocks = [(str(report["run"]), str(report["reason"])) for report in since if report.get("code") in SHOCKS]
    looked = [report for report in since if _moved(report) or _interim(_steps(report).get(DRIVE, {})) is not None]
    return CellHealth(
        calibrated, len(arrived), unlooked, tuple(series), tuple(shocks),
        moved=str(looked[-1]["run"]) if looked and _moved(looked[-1]) else "",
        age_days=(now - made).total_seconds() / DAY_S, max_age_days=max_age_s / DAY_S,
    )  # fmt: skip


DATE = "%Y-%m-%d %H:%M:%S"


def _read(folder: Path) -> Report | None:
    """The report of a job; None for other runs, and for one that tells too little."""
    try:
        report = read_report(folder)
        if report.get("kind", "job") != "job" or not report.get("calibration_date"):
            return None
        dt.datetime.strptime(str(report["calibration_date"]), DATE)
        _begun(report)
        _moved(report)
        for part, _, step, seen in WATCHED:
            found = seen(_steps(report).get(step, {}))
            if found is not None and not np.isfinite([*found[0], found[1]]).all():
                raise ValueError(f"{part} is no number")
    except (CellError, OSError, KeyError, TypeError, ValueError, AttributeError):
        return None
    return {**report, "run": folder.name}


def _stored(run: Path, calibrations: Path) -> str:
    """The date of the stored calibration of the devices that this run used; "" where there is none."""
    try:
        name = name_of(json.loads((run / "calibration.json").read_text(encoding="utf-8"))["identities"])
        return read_calibration(calibrations / f"{name}.json").date
    except (OSError, ValueError, KeyError, TypeError, AttributeError, CellError):
        return ""


def _cell(report: Report) -> tuple[object, ...]:
    """In which cell a job ran: the real one, or the simulated one of a seed and a level."""
    return str(report.get("simulated")), report.get("seed"), report.get("level")


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
    reports: Sequence[Report], part: str, unit: str, step: str, seen: Callable[[Report], Seen]
) -> DriftSeries | None:  # fmt: skip
    """What these reports tell of a part; None where no job has looked at it."""
    found = [(_begun(report), *told) for report in reports if (told := seen(_steps(report).get(step, {}))) is not None]
    if not found:
        return None
    times, values, limits = zip(*found, strict=True)
    days = (np.array(times) - times[0]) / DAY_S
    return DriftSeries(part, unit, days, np.array(values, dtype=np.float64), min(limits))


if __name__ == "__main__":
    runs, calibrations, max_age = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3])
    print(json.dumps(health(runs, calibrations, max_age, dt.datetime.now().astimezone()).as_dict()))
