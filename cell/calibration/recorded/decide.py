"""Which reading of the recorded poses agrees with the pictures: conventions are tested, not assumed.

Each reading gives flange poses; with the board as the camera sees it they give a closed-form hand-eye, and how far the
board then scatters in the base tells how well they agree. A reading is taken when no other comes near it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.conventions import Reading, readings_of, why_not
from cell.calibration.recorded.series import Series
from cell.calibration.solve.consistency import angle_apart
from cell.calibration.solve.hand_eye import park_martin
from cell.geometry.camera import Array
from cell.geometry.poses import from_parts
from drivers.errors import RefusedError

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
SETUPS = ("eye_in_hand", "eye_to_hand")
# So many frames tell the readings apart; more cost time.
MOST_FRAMES = 24
# The next best reading must leave so many times as much, and the best no more than this (rad, and share of distance).
CLEAR, AGREES = 2.5, 0.06
REWEIGHTINGS = 25
# The flange's way and the board's size may disagree by this share before it is said, and before it is refused.
SCALE_NOTE, SCALE_REFUSED, SCALE_SIGMAS = 0.015, 0.05, 4.0
# … and where that other size leaves no more than this share of the scatter.
SCALE_WRONG = 0.4
SCALE_BETTER, SCALE_CLEARLY = 0.7, 0.35


@dataclass(frozen=True, eq=False)
class Fit:
    """How well flange poses agree with the pictures: medians in rad and m, and their sum as a share of the distance.

    `reach` is the board's distance from the camera in m. `scale` is by how much the flange's way would have to be
    longer to go with the board's size, with its σ; `shift_scaled` is the median in m that this would leave.
    """

    series: Series
    reading: Reading
    setup: str
    unit: str
    turn: float
    shift: float
    score: float
    scale: float
    scale_sigma: float
    shift_scaled: float
    reach: float

    @property
    def text(self) -> str:
        """The reading in words."""
        return f"{self.reading.text} ({self.reading.name}), lengths in {self.unit}, {self.setup.replace('_', ' ')}"

    @property
    def left(self) -> str:
        """What it leaves."""
        return f"{math.degrees(self.turn):.2f}° and {1e3 * self.shift:.1f} mm"


@dataclass(frozen=True, eq=False)
class Decision:
    """The reading taken, the next best one that means something else, and what to say about both.

    `by_name`: what the poses leave that have the pictures' names, where they were taken in order instead.
    """

    best: Fit
    rival: Fit | None
    by_name: Fit | None = None

    @property
    def evidence(self) -> str:
        """Why this reading."""
        said = f"leaves {self.best.left} of scatter (medians)"
        if self.rival is None:
            return f"{said}; no other reading of the numbers is possible"
        return f"{said}; the next best, {self.rival.text}, leaves {self.rival.left}"


def decide(
    series: Sequence[Series],
    boards: dict[int, list[pin.SE3]],
    pitch: float,
    wanted: str | None = None,
    setup: str | None = None,
    in_order: Sequence[Series] = (),
) -> Decision:
    """The reading of the series that agrees with the boards that frames (by index) saw, in each order they allow.

    `pitch` of the board in m, as it was named. `in_order` are the same poses, given to the pictures in order and not by
    their names: they are taken where they agree, and clearly better.

    Raises RefusedError when none does, or when two do that mean different things; its text names the option to give.
    """
    fits, problems = _all_fits(series, boards, wanted, setup)
    ordered, _ = _all_fits(in_order, boards, wanted, setup)
    by_name = None
    if ordered and fits and ordered[0].score < AGREES and CLEAR * ordered[0].score < fits[0].score:
        by_name, fits = fits[0], ordered
    if not fits:
        records = [r for one in series for r in one.records]
        reasons = problems or [why_not(records[0].numbers, records[0].named, wanted)]
        raise RefusedError(f"the poses of {series[0].name} cannot be read: {reasons[0]}")
    best = fits[0]
    if not best.score < AGREES:
        sized = [f for f in fits if f.scale > 2 * SCALE_SIGMAS * f.scale_sigma]
        other = min(sized or fits, key=lambda f: f.turn + f.shift_scaled / f.reach)
        if sized and other.turn + other.shift_scaled / other.reach < 0.5 * AGREES:
            raise RefusedError(f"read as {other.text}, {scale_problem(other, pitch)[0]}")
        raise RefusedError(
            f"no reading of the poses agrees with the pictures: the nearest, {best.text}, leaves {best.left} of "
            "scatter; are they the poses of these pictures, of the flange, and is the board's pitch right?"
        )
    rival = next((f for f in fits[1:] if not _same(f, best, boards)), None)
    if rival is not None and rival.score < CLEAR * best.score:
        raise RefusedError(_question(best, rival))
    return Decision(best, rival, by_name)


def _all_fits(
    series: Sequence[Series], boards: dict[int, list[pin.SE3]], wanted: str | None, setup: str | None
) -> tuple[list[Fit], list[str]]:
    """All readings of the series, the best first, and why some are none."""
    fits: list[Fit] = []
    problems: list[str] = []
    for one in series:
        for reading in readings_of(one.count, one.named, wanted):
            try:
                fits += _fits(one, reading, boards, setup)
            except RefusedError as error:
                problems.append(str(error))
    return sorted(fits, key=lambda f: f.score), problems


def scale_problem(fit: Fit, pitch: float) -> tuple[str, bool]:
    """What to say where the flange's way and the board's size disagree, and whether it refuses the hand-eye."""
    off = abs(fit.scale - 1)
    if off < max(SCALE_NOTE, SCALE_SIGMAS * fit.scale_sigma) or fit.shift_scaled > SCALE_BETTER * fit.shift:
        return "", False
    text = (
        f"the flange's way fits the pictures only when it is {fit.scale:.3f} ± {fit.scale_sigma:.3f} times as long as "
        f"its poses say ({1e3 * fit.shift_scaled:.1f} mm of scatter instead of {1e3 * fit.shift:.1f} mm): is the "
        f"board's pitch {1e3 * pitch / fit.scale:.2f} mm and not {1e3 * pitch:.2f} mm?"
    )
    return text, off > SCALE_REFUSED and fit.shift_scaled < SCALE_CLEARLY * fit.shift


def _fits(one: Series, reading: Reading, boards: dict[int, list[pin.SE3]], setup: str | None) -> list[Fit]:
    poses = {k: p for k, p in one.poses(reading).items() if k in boards}
    if len(poses) < 3 or len(poses) < 0.5 * len([k for k in one.of if k in boards]):
        return []
    keys = sorted(poses)
    if len(keys) > MOST_FRAMES:
        keys = [keys[k] for k in np.linspace(0, len(keys) - 1, MOST_FRAMES).round().astype(int)]
    found = []
    for side in SETUPS if setup is None else (setup,):
        flanges = [poses[k] if side == "eye_in_hand" else poses[k].inverse() for k in keys]
        seen = _ordered(flanges, [boards[k] for k in keys])
        rotation, turn, kept = _rotation(flanges, seen)
        reach = float(np.median([np.linalg.norm(b.translation) for b in seen]))
        flanges, seen = [flanges[k] for k in kept], [seen[k] for k in kept]
        tried = []
        for unit, size in UNITS.items():
            shift = float(np.median(_shifts(flanges, seen, rotation, size)[0]))
            tried.append((shift, unit, size))
        off, scale, sigma = _shifts(flanges, seen, rotation, None)
        # The unit nearest to what fits best, where that is a size at all; else that which leaves least.
        shift, unit, size = min(tried)
        if scale > 4 * sigma > 0:
            shift, unit, size = min(tried, key=lambda t: abs(math.log(scale / t[2])))
        score, best = turn + shift / reach, float(np.median(off))
        if abs(scale / size - 1) > SCALE_WRONG or scale < SCALE_SIGMAS * sigma:
            # A unit so small that the flange seems at rest fits boards that hardly move in the picture, in any reading.
            score += 1.0
        found.append(Fit(one, reading, side, unit, turn, shift, score, scale / size, sigma / size, best, reach))
    return found


def _ordered(flanges: Sequence[pin.SE3], options: Sequence[list[pin.SE3]]) -> list[pin.SE3]:
    """Of boards that look the same turned, the order that goes with the flange's turns."""
    chosen: list[pin.SE3] = []
    for flange, poses in zip(flanges, options, strict=True):
        if chosen and len(poses) > 1:
            before = list(zip(flanges, chosen, strict=False))
            misfit = [np.median([angle_apart(flange, pose, f, p) for f, p in before]) for pose in poses]
            chosen.append(poses[int(np.argmin(misfit))])
        else:
            chosen.append(poses[0])
    return chosen


def _rotation(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> tuple[Array, float, list[int]]:
    """flange_from_camera (3, 3), median turn in rad of the boards in the base, and the frames that agree."""
    kept = list(range(len(flanges)))
    rotation, turn = np.eye(3), math.inf
    for _ in range(3):
        rotation = park_martin([flanges[k] for k in kept], [boards[k] for k in kept])
        there = [f.rotation @ rotation @ b.rotation for f, b in zip(flanges, boards, strict=True)]
        apart = np.array([[_angle(a, b) for b in there] for a in there])
        middle = int(np.argmin(np.median(apart, axis=1)))
        turn = float(np.median(np.delete(apart[middle], middle)))
        agree = [k for k in range(len(flanges)) if apart[middle, k] <= max(4 * turn, 0.02)]
        if agree == kept or len(agree) < max(3, 0.6 * len(flanges)):
            break
        kept = agree
    return rotation, turn, kept


def _angle(a: Array, b: Array) -> float:
    return math.acos(max(-1.0, min(1.0, 0.5 * (float(np.sum(a * b)) - 1))))


def _shifts(
    flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3], rotation: Array, size: float | None
) -> tuple[Array, float, float]:
    """Distances (n,) in m of the boards' origins from one place, and the size of the poses' unit in m with its σ.

    By least sum of distances; `size` None lets the unit's size be found with the rest.
    """
    design, known = [], []
    for f, b in zip(flanges, boards, strict=True):
        seen = f.rotation @ rotation @ b.translation
        way = f.translation[:, None]
        design.append(np.hstack([f.rotation, -np.eye(3), way] if size is None else [f.rotation, -np.eye(3)]))
        known.append(seen if size is None else seen + size * f.translation)
    # An arm's base may be metres away and its unit mm: columns of one size keep the system well conditioned.
    whole, right = np.array(design), np.array(known)
    norms = np.linalg.norm(whole.reshape(-1, whole.shape[2]), axis=0) + 1e-12
    off = np.ones(len(whole))
    for _ in range(REWEIGHTINGS):
        root = np.sqrt(1 / np.maximum(off, 1e-4))[:, None]
        a = (whole / norms * root[:, :, None]).reshape(-1, len(norms))
        solution = np.linalg.lstsq(a, -(right * root).ravel(), rcond=None)[0]
        off = np.linalg.norm(whole / norms @ solution + right, axis=1)
    if size is not None:
        return off, size, 0.0
    left = float(np.sum((a @ solution + (right * root).ravel()) ** 2)) / max(1, a.shape[0] - a.shape[1])
    sigma = math.sqrt(left * float(np.linalg.pinv(a.T @ a)[-1, -1]))
    return off, float(solution[-1] / norms[-1]), float(sigma / norms[-1])


def _same(a: Fit, b: Fit, boards: dict[int, list[pin.SE3]]) -> bool:
    """True where both readings give the same poses."""
    if a.setup != b.setup or a.unit != b.unit:
        return False
    first, second = a.series.poses(a.reading), b.series.poses(b.reading)
    both = [k for k in first if k in second and k in boards]
    return len(both) >= 3 and all(
        _angle(first[k].rotation, second[k].rotation) < 1e-3
        and np.linalg.norm(first[k].translation - second[k].translation)
        < 1e-6 * (1 + np.linalg.norm(first[k].translation))
        for k in both
    )


def _question(best: Fit, rival: Fit) -> str:
    if best.series is not rival.series:
        option = f"--pose-field {best.series.name} or --pose-field {rival.series.name}"
    elif best.reading is not rival.reading:
        option = f"--poses {best.reading.name} or --poses {rival.reading.name}"
    else:
        option = "--setup eye-in-hand or --setup eye-to-hand"
    return (
        f"the poses can be read in two ways that agree with the pictures about equally: {best.text} leaves "
        f"{best.left}, {rival.text} leaves {rival.left}; say which with {option}, or add frames with larger turns"
    )


def scaled(pose: pin.SE3, unit: str) -> pin.SE3:
    """The pose with its lengths in m."""
    return from_parts(UNITS[unit] * pose.translation, pose.rotation)
