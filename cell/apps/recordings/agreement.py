"""Which reading of the recorded poses agrees with the pictures: conventions are tested, not assumed.

Each reading gives flange poses; with the board as the camera sees it they give a closed-form hand-eye, and how far the
board then scatters in the base tells how well they agree. A reading is taken when no other comes near it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.apps.recordings.consistency import board_shifts, odd_turns, orders, turn_votes, turns_between, weighted_median
from cell.apps.recordings.conventions import FORM, TRIED, PoseReading, readings_of, why_not
from cell.apps.recordings.frames import near
from cell.apps.recordings.series import Series
from cell.measure.calibration.solve.starts import park_martin
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import from_parts
from drivers.errors import RefusedError

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
# So many frames tell the readings apart; more cost time.
MOST_FRAMES = 24
# The size of the poses' unit is told from 0 by so many of its σ, and is that of the unit to this share.
SCALE_SIGMAS, SCALE_WRONG = 4.0, 0.4
# Boards further off than so many times the median, and than this share of their distance, have no say in it.
FAR_RATIO, FAR_SHARE = 10.0, 0.1
# A camera so near to the base's origin, as a share of the board's distance, and so much along its axes is the base.
OWN_SHARE, OWN_TURN = 0.05, 0.1
# The next best reading must leave so many times as much, and the best no more than this (rad, and share of distance).
CLEAR, AGREES = 2.5, 0.06
# … or leave as much turn and so many times the shift, of at least this share of the distance: an inverse turns alike.
AS_MUCH, CLEAR_SHIFT, LEAST_SHIFT = 0.95, 5.0, 0.002
# The flange's way and the board's size may disagree by this share before it is said, and before it is refused …
SCALE_NOTE, SCALE_REFUSED = 0.015, 0.05
# … and where that other size leaves no more than this share of the scatter.
SCALE_BETTER, SCALE_CLEARLY = 0.7, 0.35
# Poses that were written with few digits, or in two files, are the same to this.
SAME_RAD, SAME_M = 1e-3, 2e-4
NAME_IT = f"another convention is named with --poses, as {FORM}"


@dataclass(frozen=True, eq=False)
class Fit:
    """How well flange poses agree with the pictures: medians in rad and m, and their sum as a share of the distance.

    `reach` is the board's distance from the camera in m. `scale` is by how much the flange's way would have to be
    longer to go with the board's size, with its σ; `shift_scaled` is the median in m that this would leave, `hand` the
    flange_from_camera that it would give, of a camera that stands base_from_camera, and `stands` base_from_board.
    """

    series: Series
    reading: PoseReading
    setup: str
    unit: str
    turn: float
    shift: float
    score: float
    scale: float
    scale_sigma: float
    shift_scaled: float
    reach: float
    hand: pin.SE3
    stands: pin.SE3

    @property
    def boards_own(self) -> bool:
        """True for poses of the board as the camera sees it, not of a flange. The camera would sit in the base's
        origin; or, turned round, be the flange itself, and the board the base."""
        if not along_axes(self.hand.rotation) or np.linalg.norm(self.hand.translation) > OWN_SHARE * self.reach:
            return False
        if self.setup == "eye_to_hand":
            return True
        return along_axes(self.stands.rotation) and float(np.linalg.norm(self.stands.translation)) < self.reach / 2

    @property
    def score_scaled(self) -> float:
        """The score with lengths of any size."""
        return self.turn + self.shift_scaled / self.reach

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
    series: Sequence[Series], boards: dict[int, list[pin.SE3]], pitch: float, wanted: str | None = None,
    setup: str | None = None,
) -> Decision:  # fmt: skip
    """The reading of the series that agrees with the boards that frames (by index) saw, in each order they allow.

    `pitch` of the board in m, as it was named. Raises RefusedError when none does, or when two do that mean different
    things; its text names the option to give.
    """
    fits, problems = _fits(series, boards, wanted, setup)
    own = {f.series.name: f for f in fits if f.boards_own and f.score_scaled < AGREES}
    if own and all(one.name in own for one in series):
        raise RefusedError(_boards_own(next(iter(own.values()))))
    fits = [f for f in fits if f.series.name not in own]
    if not fits:
        first = series[0].records[0]
        reason = (problems or [why_not(first.numbers, first.named, wanted)])[0]
        raise RefusedError(f"the poses of {series[0].name} cannot be read: {reason}; {NAME_IT}")
    best = _best(fits)
    if not best.score < AGREES:
        raise RefusedError(_none_agrees(fits, pitch))
    rival = _rival(best, fits, boards)
    if rival is not None and not _clearly_worse(rival, best):
        raise RefusedError(_question(best, rival))
    return Decision(best, rival, sorted(own))


def _rival(best: Fit, fits: Sequence[Fit], boards: dict[int, list[pin.SE3]]) -> Fit | None:
    """The next best that means something else: the same poses in another file do not."""
    rival = next((f for f in fits if f is not best and not _same(f, best, boards)), None)
    if rival is None:
        return None
    return next((f for f in fits if f.series is best.series and _same(f, rival, boards)), rival)


def _best(fits: Sequence[Fit]) -> Fit:
    """The first of the fits. What names say holds where it agrees, too: an order is shifted by one pose that lacks."""
    first = fits[0]
    named = [f for f in fits if f.series.name == first.series.name and f.series.by != first.series.by == "order"]
    return next((f for f in named if f.score < AGREES and not _clearly_worse(f, first)), first)


def _clearly_worse(rival: Fit, best: Fit) -> bool:
    """Whether a rival leaves clearly more in all, or turns alike and leaves more in where it puts the board."""
    shift = CLEAR_SHIFT * max(best.shift, LEAST_SHIFT * best.reach)
    return rival.score >= CLEAR * best.score or (rival.turn >= AS_MUCH * best.turn and rival.shift >= shift)


def _fits(
    series: Sequence[Series], boards: dict[int, list[pin.SE3]], wanted: str | None, setup: str | None
) -> tuple[list[Fit], list[str]]:
    """The fits of every reading of the series, the best first, and why some give none."""
    fits: list[Fit] = []
    problems: list[str] = []
    for one in series:
        first = one.records[0]
        for reading in readings_of(len(first.numbers), first.named, wanted):
            poses = {k: pose for k, pose in one.poses(reading).items() if k in boards}
            if len(poses) < 3 or len(poses) < 0.5 * sum(k in boards for k in one.of):
                continue
            keys = sorted(poses)
            if len(keys) > MOST_FRAMES:
                keys = [keys[k] for k in np.linspace(0, len(keys) - 1, MOST_FRAMES).round().astype(int)]
            for side in ("eye_in_hand", "eye_to_hand") if setup is None else (setup,):
                flanges = [poses[k] if side == "eye_in_hand" else poses[k].inverse() for k in keys]
                try:
                    fits.append(_fit(one, reading, side, flanges, [boards[k] for k in keys]))
                except RefusedError as error:
                    problems.append(str(error))
                    break
    return sorted(fits, key=lambda fit: fit.score), problems


def _boards_own(fit: Fit) -> str:
    turned = "" if fit.setup == "eye_to_hand" else ", or of the camera as the board sees it"
    return (
        f"the poses of {fit.series.name} are those of the board as the camera sees it{turned}, not of the flange: "
        f"read as {fit.text} they put the camera {1e3 * float(np.linalg.norm(fit.hand.translation)):.1f} mm from "
        "the origin and along its axes; give the poses that the arm's controller told"
    )


def _none_agrees(fits: Sequence[Fit], pitch: float) -> str:
    best = fits[0]
    sized = [f for f in fits if f.scale > 2 * SCALE_SIGMAS * f.scale_sigma]
    other = min(sized or fits, key=lambda f: f.score_scaled)
    if sized and other.score_scaled < 0.5 * AGREES:
        return f"read as {other.text}, {scale_problem(other, pitch)[0]}"
    return (
        f"no reading of the poses agrees with the pictures: the nearest, {best.text}, leaves {best.left} of "
        "scatter; are they the poses of these pictures in this order, of the flange (and not joint angles), and is "
        f"the board's pitch right? Tried were {', '.join(TRIED)}; {NAME_IT}"
    )


def _question(best: Fit, rival: Fit) -> str:
    option = "--setup eye-in-hand or --setup eye-to-hand"
    if best.series is not rival.series:
        option = f"--pose-field {best.series.name} or --pose-field {rival.series.name}"
    elif best.reading != rival.reading:
        option = f"--poses {best.reading.name} or --poses {rival.reading.name}"
    if rival.score >= AGREES:
        return (
            f"the poses agree with the pictures in no way clearly: {best.text} leaves {best.left}, {rival.text} leaves "
            f"{rival.left}; are some of them in another unit, or of other pictures? Correct them, or take them out"
        )
    return (
        f"the poses can be read in two ways that agree with the pictures about equally: {best.text} leaves "
        f"{best.left}, {rival.text} leaves {rival.left}; say which with {option}, or add frames with larger turns"
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
    first, second = a.series.poses(a.reading), b.series.poses(b.reading)
    both = [k for k in first if k in second and k in boards]
    poses = [
        [from_parts(UNITS[fit.unit] * told[k].translation, told[k].rotation) for k in both]
        for fit, told in ((a, first), (b, second))
    ]
    alike = (near(one, other, SAME_M, SAME_RAD) for one, other in zip(*poses, strict=True))
    return a.setup == b.setup and len(both) >= 3 and all(alike)


def _fit(
    one: Series, reading: PoseReading, setup: str, flanges: Sequence[pin.SE3], options: Sequence[list[pin.SE3]]
) -> Fit:
    """How well flange poses go with the boards, of each the poses that it may have. Raises RefusedError where the turns
    tell nothing."""
    seen = [views[turn] for views, turn in zip(options, orders(flanges, options), strict=True)]
    rotation, turn, kept = _rotation(flanges, seen)
    reach = float(np.median([np.linalg.norm(b.translation) for b in seen]))
    flanges, seen = [flanges[k] for k in kept], [seen[k] for k in kept]
    offs = {unit: board_shifts(flanges, seen, rotation, size)[0] for unit, size in UNITS.items()}
    unit = min(offs, key=lambda u: float(np.median(offs[u])))
    # A pose that is far from all others, in another unit for example, tells nothing of the unit of these.
    off = offs[unit]
    close = np.flatnonzero(off <= max(FAR_RATIO * float(np.median(off)), FAR_SHARE * reach))
    off, scale, sigma, place = board_shifts([flanges[k] for k in close], [seen[k] for k in close], rotation, None)
    # The unit nearest to what fits best, where that is a size at all; else that which leaves least.
    if scale > 4 * sigma > 0:
        unit = min(offs, key=lambda u: abs(math.log(scale / UNITS[u])))
    shift, size = float(np.median(offs[unit])), UNITS[unit]
    # A unit so small that the flange seems at rest fits boards that hardly move in the picture, in any reading.
    small = abs(scale / size - 1) > SCALE_WRONG or scale < SCALE_SIGMAS * sigma
    score = turn + shift / reach + (1.0 if small else 0.0)
    hand = from_parts(place, rotation)
    stands = from_parts(scale * flanges[close[0]].translation, flanges[close[0]].rotation) * hand * seen[close[0]]
    scaled = scale / size, sigma / size, float(np.median(off))
    return Fit(one, reading, setup, unit, turn, shift, score, *scaled, reach, hand, stands)


def _rotation(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> tuple[Array, float, list[int]]:
    """flange_from_camera (3, 3), median turn in rad of the boards in the base, and the frames that agree."""
    # What turned by another angle than the board did is of another frame, whatever the hand-eye: it would bend it.
    odd = odd_turns(flanges, boards)
    kept = [k for k in range(len(flanges)) if k not in odd]
    # A view that is turned like most agrees with these whatever the rotation: those that turn decide.
    votes = turn_votes(flanges, boards)
    rotation, turn = np.eye(3), math.inf
    for _ in range(3):
        rotation = park_martin([flanges[k] for k in kept], [boards[k] for k in kept])
        hand = from_parts((0.0, 0.0, 0.0), rotation)
        apart = turns_between([f * hand * b for f, b in zip(flanges, boards, strict=True)])
        typical = weighted_median(apart, votes)
        middle = int(np.argmin(typical))
        turn = float(typical[middle])
        agree = [k for k in range(len(flanges)) if apart[middle, k] <= max(4 * turn, 0.02)]
        if agree == kept or len(agree) < 3 or votes[agree].sum() < 0.6 * votes.sum():
            break
        kept = agree
    return rotation, turn, kept


def along_axes(rotation: Array) -> bool:
    """True for a rotation (3, 3) that only exchanges axes, or none."""
    return bool(np.all((np.abs(rotation) < OWN_TURN) | (np.abs(rotation) > 1 - OWN_TURN)))
