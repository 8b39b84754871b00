"""Which reading of the recorded poses agrees with the pictures: conventions are tested, not assumed.

Each reading gives flange poses; with the board as the camera sees it they give a closed-form hand-eye, and how far the
board then scatters in the base tells how well they agree. A reading is taken when no other comes near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.agreement import SCALE_SIGMAS, UNITS, Fit, angle, fits_of
from cell.calibration.recorded.conventions import FORM, TRIED, readings_of, why_not
from cell.calibration.recorded.series import Series
from cell.calibration.solve.consistency import orders, turns_apart
from drivers.errors import RefusedError

# The next best reading must leave so many times as much, and the best no more than this (rad, and share of distance).
CLEAR, AGREES = 2.5, 0.06
# … or leave as much turn and so many times the shift, of at least this share of the distance: an inverse turns alike.
AS_MUCH, CLEAR_SHIFT, LEAST_SHIFT = 0.95, 5.0, 0.002
# Poses that are shifted by one picture are named when they then agree so much better, in so many frames.
SHIFTED, LEAST_SHIFTED = 0.5, 6
QUICK_LOOK, ALIKE = 24, 0.2
# The flange's way and the board's size may disagree by this share before it is said, and before it is refused.
SCALE_NOTE, SCALE_REFUSED = 0.015, 0.05
# … and where that other size leaves no more than this share of the scatter.
SCALE_BETTER, SCALE_CLEARLY = 0.7, 0.35

# Units in which no arm is asked to tell its poses, but some do, in m, and how near the size must be.
OTHER_UNITS, OTHER_SHARE = {"inches": 0.0254, "feet": 0.3048, "tenths of a mm": 1e-4, "µm": 1e-6}, 0.03

# Poses that were written with few digits, or in two files, are the same to this.
SAME_RAD, SAME_M = 1e-3, 2e-4


@dataclass(frozen=True, eq=False)
class Decision:
    """The reading taken, the next best one that means something else, and what to say about both.

    `by_name`: what the poses leave that have the pictures' names, where they were taken in order instead. `boards_own`:
    series that hold the board's poses as the camera sees it.
    """

    best: Fit
    rival: Fit | None
    by_name: Fit | None = None
    boards_own: Sequence[str] = ()

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
    shifts: Sequence[int] = (1, -1),
) -> Decision:
    """The reading of the series that agrees with the boards that frames (by index) saw, in each order they allow.

    `pitch` of the board in m, as it was named. `in_order` are the same poses, given to the pictures in order and not by
    their names: they are taken where they agree, and clearly better. `shifts`: where nothing agrees it is asked whether
    poses and pictures are shifted by so many.

    Raises RefusedError when none does, or when two do that mean different things; its text names the option to give.
    """
    fits, problems = _all_fits(series, boards, wanted, setup)
    own = {f.series.name: f for f in fits if f.boards_own and f.turn + f.shift_scaled / f.reach < AGREES}
    fits = [f for f in fits if f.series.name not in own]
    series = [one for one in series if one.name not in own]
    in_order = [one for one in in_order if one.name not in own]
    if own and not series:
        raise RefusedError(_boards_own(next(iter(own.values()))))
    ordered, _ = _all_fits(in_order, boards, wanted, setup)
    by_name = None
    if ordered and fits and ordered[0].score < AGREES and CLEAR * ordered[0].score < fits[0].score:
        by_name, fits = fits[0], ordered
    if not fits:
        records = [r for one in series for r in one.records]
        reasons = problems or [why_not(records[0].numbers, records[0].named, wanted)]
        raise RefusedError(
            f"the poses of {series[0].name} cannot be read: {reasons[0]}; another convention is named with --poses, as "
            f"{FORM}"
        )
    best = fits[0]
    if not best.score < AGREES:
        sized = [f for f in fits if f.scale > 2 * SCALE_SIGMAS * f.scale_sigma]
        other = min(sized or fits, key=lambda f: f.turn + f.shift_scaled / f.reach)
        if sized and other.turn + other.shift_scaled / other.reach < 0.5 * AGREES:
            raise RefusedError(f"read as {other.text}, {scale_problem(other, pitch)[0]}")
        raise RefusedError(
            f"no reading of the poses agrees with the pictures: the nearest, {best.text}, leaves {best.left} of "
            f"scatter; {_shifted(series, boards, wanted, setup, shifts)}"
        )
    rival = next((f for f in fits[1:] if not _same(f, best, boards)), None)
    if rival is not None:
        # The same poses in another file are no other meaning.
        rival = next((f for f in fits if f.series is best.series and _same(f, rival, boards)), rival)
    if rival is not None and not clearly_worse(rival, best):
        raise RefusedError(_question(best, rival))
    return Decision(best, rival, by_name, sorted(own))


def clearly_worse(rival: Fit, best: Fit) -> bool:
    """True where a reading leaves so much more that it cannot be meant, in all or in where it puts the board."""
    return rival.score >= CLEAR * best.score or (
        rival.turn >= AS_MUCH * best.turn and rival.shift >= CLEAR_SHIFT * max(best.shift, LEAST_SHIFT * best.reach)
    )


def _all_fits(
    series: Sequence[Series], boards: dict[int, list[pin.SE3]], wanted: str | None, setup: str | None
) -> tuple[list[Fit], list[str]]:
    """All readings of the series, the best first, and why some are none."""
    fits: list[Fit] = []
    problems: list[str] = []
    for one in series:
        for reading in readings_of(one.count, one.named, wanted):
            try:
                fits += fits_of(one, reading, boards, setup)
            except RefusedError as error:
                problems.append(str(error))
    return sorted(fits, key=lambda f: f.score), problems


def _shifted(
    series: Sequence[Series],
    boards: dict[int, list[pin.SE3]],
    wanted: str | None,
    setup: str | None,
    shifts: Sequence[int],
) -> str:
    """The question that poses ask which agree with no picture: do they with the one before or after?"""
    for step in shifts:
        moved = []
        for one in series:
            keys = sorted(one.of)
            of = {k: one.of[keys[i + step]] for i, k in enumerate(keys) if 0 <= i + step < len(keys)}
            moved.append(replace(one, of=of))
        if not _turn_alike(moved, boards, wanted):
            continue
        fits, _ = _all_fits(moved, boards, wanted, setup)
        if fits and fits[0].score < SHIFTED * AGREES and len(boards) >= LEAST_SHIFTED:
            return (
                f"with the pose of the {'next' if step > 0 else 'previous'} picture, {fits[0].text}, they leave "
                f"{fits[0].left}: are poses and pictures shifted by one, and one of either missing? Number them anew"
            )
    angles = any(one.count == 6 for one in series)
    return (
        f"are they the poses of these pictures, of the flange{' (and not joint angles)' if angles else ''}, and is the "
        f"board's pitch right? Tried were {', '.join(TRIED)}; another convention is named with --poses, as {FORM}"
    )


def _turn_alike(series: Sequence[Series], boards: dict[int, list[pin.SE3]], wanted: str | None) -> bool:
    """True where the flange turned as the board did in a reading of the poses: a quick look before all are tried."""
    for one in series:
        keys = sorted(one.of.keys() & boards.keys())[:QUICK_LOOK]
        for reading in readings_of(one.count, one.named, wanted):
            poses = one.poses(reading)
            both = [k for k in keys if k in poses]
            if len(both) < 3:
                continue
            flanges = [poses[k] for k in both]
            seen = [boards[k][turn] for k, turn in zip(both, orders(flanges, [boards[k] for k in both]), strict=True)]
            if turns_apart(flanges, seen) < ALIKE:
                return True
    return False


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
    size = fit.scale * UNITS[fit.unit]
    other = next((name for name, unit in OTHER_UNITS.items() if abs(size / unit - 1) < OTHER_SHARE), None)
    if other is not None:
        text = f"{text} Or are the positions in {other}? Write them in mm"
    return text, off > SCALE_REFUSED and fit.shift_scaled < SCALE_CLEARLY * fit.shift


def _same(a: Fit, b: Fit, boards: dict[int, list[pin.SE3]]) -> bool:
    """True where both readings give the same poses, from another file in another unit maybe."""
    if a.setup != b.setup:
        return False
    first, second = a.series.poses(a.reading), b.series.poses(b.reading)
    both = [k for k in first if k in second and k in boards]
    return len(both) >= 3 and all(
        angle(first[k].rotation, second[k].rotation) < SAME_RAD
        and np.linalg.norm(UNITS[a.unit] * first[k].translation - UNITS[b.unit] * second[k].translation) < SAME_M
        for k in both
    )


def _boards_own(fit: Fit) -> str:
    turned = "" if fit.setup == "eye_to_hand" else ", or of the camera as the board sees it"
    return (
        f"the poses of {fit.series.name} are those of the board as the camera sees it{turned}, not of the flange: read "
        f"as {fit.text} they put the camera {1e3 * float(np.linalg.norm(fit.hand.translation)):.1f} mm from the origin "
        "and along its axes; give the poses that the arm's controller told"
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
