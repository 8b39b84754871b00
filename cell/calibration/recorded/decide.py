"""Which reading of the recorded poses agrees with the pictures: conventions are tested, not assumed.

Each reading gives flange poses; with the board as the camera sees it they give a closed-form hand-eye, and how far the
board then scatters in the base tells how well they agree. A reading is taken when no other comes near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.agreement import SCALE_SIGMAS, UNITS, Fit, angle, fits_of
from cell.calibration.recorded.conventions import FORM, TRIED, readings_of, why_not
from cell.calibration.recorded.series import Series
from drivers.errors import RefusedError

# The next best reading must leave so many times as much, and the best no more than this (rad, and share of distance).
CLEAR, AGREES = 2.5, 0.06
# … or leave as much turn and so many times the shift, of at least this share of the distance: an inverse turns alike.
AS_MUCH, CLEAR_SHIFT, LEAST_SHIFT = 0.95, 5.0, 0.002
# The flange's way and the board's size may disagree by this share before it is said, and before it is refused.
SCALE_NOTE, SCALE_REFUSED = 0.015, 0.05
# … and where that other size leaves no more than this share of the scatter.
SCALE_BETTER, SCALE_CLEARLY = 0.7, 0.35
# Poses that were written with few digits, or in two files, are the same to this.
SAME_RAD, SAME_M = 1e-3, 2e-4
NAME_IT = f"another convention is named with --poses, as {FORM}"


@dataclass(frozen=True, eq=False)
class Decision:
    """The reading taken, the next best that means something else, and series that hold the board's own poses."""

    best: Fit
    rival: Fit | None
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
) -> Decision:
    """The reading of the series that agrees with the boards that frames (by index) saw, in each order they allow.

    `pitch` of the board in m, as it was named. Raises RefusedError when none does, or when two do that mean different
    things; its text names the option to give.
    """
    fits: list[Fit] = []
    problems: list[str] = []
    for one in series:
        for reading in readings_of(one.count, one.named, wanted):
            try:
                fits += fits_of(one, reading, boards, setup)
            except RefusedError as error:
                problems.append(str(error))
    fits.sort(key=lambda f: f.score)
    own = {f.series.name: f for f in fits if f.boards_own and f.turn + f.shift_scaled / f.reach < AGREES}
    fits = [f for f in fits if f.series.name not in own]
    if own and all(one.name in own for one in series):
        raise RefusedError(_boards_own(next(iter(own.values()))))
    if not fits:
        first = series[0].records[0]
        reasons = problems or [why_not(first.numbers, first.named, wanted)]
        raise RefusedError(f"the poses of {series[0].name} cannot be read: {reasons[0]}; {NAME_IT}")
    best = fits[0]
    if not best.score < AGREES:
        sized = [f for f in fits if f.scale > 2 * SCALE_SIGMAS * f.scale_sigma]
        other = min(sized or fits, key=lambda f: f.turn + f.shift_scaled / f.reach)
        if sized and other.turn + other.shift_scaled / other.reach < 0.5 * AGREES:
            raise RefusedError(f"read as {other.text}, {scale_problem(other, pitch)[0]}")
        raise RefusedError(
            f"no reading of the poses agrees with the pictures: the nearest, {best.text}, leaves {best.left} of "
            "scatter; are they the poses of these pictures in this order, of the flange (and not joint angles), and is "
            f"the board's pitch right? Tried were {', '.join(TRIED)}; {NAME_IT}"
        )
    rival = next((f for f in fits[1:] if not _same(f, best, boards)), None)
    if rival is not None:
        # The same poses in another file are no other meaning.
        rival = next((f for f in fits if f.series is best.series and _same(f, rival, boards)), rival)
    if rival is not None and not clearly_worse(rival, best):
        raise RefusedError(_question(best, rival))
    return Decision(best, rival, sorted(own))


def clearly_worse(rival: Fit, best: Fit) -> bool:
    """True where a reading leaves so much more that it cannot be meant, in all or in where it puts the board."""
    return rival.score >= CLEAR * best.score or (
        rival.turn >= AS_MUCH * best.turn and rival.shift >= CLEAR_SHIFT * max(best.shift, LEAST_SHIFT * best.reach)
    )


def scale_problem(fit: Fit, pitch: float) -> tuple[str, bool]:
    """What to say where the flange's way and the board's size disagree, and whether it refuses the hand-eye."""
    off = abs(fit.scale - 1)
    if off < max(SCALE_NOTE, SCALE_SIGMAS * fit.scale_sigma) or fit.shift_scaled > SCALE_BETTER * fit.shift:
        return "", False
    text = (
        f"the flange's way fits the pictures only when it is {fit.scale:.3f} ± {fit.scale_sigma:.3f} times as long as "
        f"its poses say ({1e3 * fit.shift_scaled:.1f} mm of scatter instead of {1e3 * fit.shift:.1f} mm): is the "
        f"board's pitch {1e3 * pitch / fit.scale:.2f} mm and not {1e3 * pitch:.2f} mm, or are the positions in a unit "
        "other than m, cm and mm?"
    )
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
    elif best.reading != rival.reading:
        option = f"--poses {best.reading.name} or --poses {rival.reading.name}"
    else:
        option = "--setup eye-in-hand or --setup eye-to-hand"
    return (
        f"the poses can be read in two ways that agree with the pictures about equally: {best.text} leaves "
        f"{best.left}, {rival.text} leaves {rival.left}; say which with {option}, or add frames with larger turns"
    )
