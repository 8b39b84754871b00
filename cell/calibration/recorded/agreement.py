"""How well a reading of the poses agrees with the pictures: a closed-form hand-eye, and how the board scatters then."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.conventions import Reading
from cell.calibration.recorded.series import Series
from cell.calibration.solve.consistency import odd_turns, orders, turn_votes, weighted_median
from cell.calibration.solve.hand_eye import park_martin
from cell.geometry.camera import Array
from cell.geometry.poses import from_parts

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
SETUPS = ("eye_in_hand", "eye_to_hand")
# So many frames tell the readings apart; more cost time.
MOST_FRAMES = 24
REWEIGHTINGS = 25
# The size of the poses' unit is told from 0 by so many of its σ, and is that of the unit to this share.
SCALE_SIGMAS, SCALE_WRONG = 4.0, 0.4
# Boards further off than so many times the median, and than this share of their distance, have no say in it.
FAR_RATIO, FAR_SHARE = 10.0, 0.1
# A camera so near to the base's origin, as a share of the board's distance, and so much along its axes is the base.
OWN_SHARE, OWN_TURN = 0.05, 0.1


@dataclass(frozen=True, eq=False)
class Fit:
    """How well flange poses agree with the pictures: medians in rad and m, and their sum as a share of the distance.

    `reach` is the board's distance from the camera in m. `scale` is by how much the flange's way would have to be
    longer to go with the board's size, with its σ; `shift_scaled` is the median in m that this would leave, `hand` the
    flange_from_camera that it would give, of a camera that stands base_from_camera, and `stands` base_from_board.
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
    hand: pin.SE3
    stands: pin.SE3

    @property
    def boards_own(self) -> bool:
        """True for poses of the board as the camera sees it, not of a flange.

        The camera would sit in the base's origin; or, turned round, be the flange itself, and the board the base.
        """
        if not _axes(self.hand.rotation) or np.linalg.norm(self.hand.translation) > OWN_SHARE * self.reach:
            return False
        if self.setup == "eye_to_hand":
            return True
        return _axes(self.stands.rotation) and float(np.linalg.norm(self.stands.translation)) < self.reach / 2

    @property
    def text(self) -> str:
        """The reading in words."""
        return f"{self.reading.text} ({self.reading.name}), lengths in {self.unit}, {self.setup.replace('_', ' ')}"

    @property
    def left(self) -> str:
        """What it leaves."""
        return f"{math.degrees(self.turn):.2f}° and {1e3 * self.shift:.1f} mm"


def fits_of(one: Series, reading: Reading, boards: dict[int, list[pin.SE3]], setup: str | None) -> list[Fit]:
    """The fits of a reading, one for each set-up; none where too few frames have a pose in it.

    Raises RefusedError where the turns tell nothing.
    """
    poses = {k: p for k, p in one.poses(reading).items() if k in boards}
    if len(poses) < 3 or len(poses) < 0.5 * len([k for k in one.of if k in boards]):
        return []
    keys = sorted(poses)
    if len(keys) > MOST_FRAMES:
        keys = [keys[k] for k in np.linspace(0, len(keys) - 1, MOST_FRAMES).round().astype(int)]
    found = []
    for side in SETUPS if setup is None else (setup,):
        flanges = [poses[k] if side == "eye_in_hand" else poses[k].inverse() for k in keys]
        options = [boards[k] for k in keys]
        seen = [poses[turn] for poses, turn in zip(options, orders(flanges, options), strict=True)]
        rotation, turn, kept = _rotation(flanges, seen)
        reach = float(np.median([np.linalg.norm(b.translation) for b in seen]))
        flanges, seen = [flanges[k] for k in kept], [seen[k] for k in kept]
        tried = []
        for unit, size in UNITS.items():
            off = _shifts(flanges, seen, rotation, size)[0]
            tried.append((float(np.median(off)), unit, size, off))
        # A pose that is far from all others, in another unit for example, tells nothing of the unit of these.
        off = min(tried, key=lambda t: t[0])[3]
        near = np.flatnonzero(off <= max(FAR_RATIO * float(np.median(off)), FAR_SHARE * reach))
        off, scale, sigma, hand = _shifts([flanges[k] for k in near], [seen[k] for k in near], rotation, None)
        # The unit nearest to what fits best, where that is a size at all; else that which leaves least.
        shift, unit, size, _ = min(tried, key=lambda t: t[0])
        if scale > 4 * sigma > 0:
            shift, unit, size, _ = min(tried, key=lambda t: abs(math.log(scale / t[2])))
        score, best = turn + shift / reach, float(np.median(off))
        if abs(scale / size - 1) > SCALE_WRONG or scale < SCALE_SIGMAS * sigma:
            # A unit so small that the flange seems at rest fits boards that hardly move in the picture, in any reading.
            score += 1.0
        flange_from_camera = from_parts(hand, rotation)
        stands = from_parts(scale * flanges[near[0]].translation, flanges[near[0]].rotation)
        stands = stands * flange_from_camera * seen[near[0]]
        found.append(
            Fit(
                one, reading, side, unit, turn, shift, score, scale / size, sigma / size, best, reach,
                flange_from_camera, stands,
            )
        )  # fmt: skip
    return found


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
        there = [f.rotation @ rotation @ b.rotation for f, b in zip(flanges, boards, strict=True)]
        apart = np.array([[angle(a, b) for b in there] for a in there])
        typical = weighted_median(apart, votes)
        middle = int(np.argmin(typical))
        turn = float(typical[middle])
        agree = [k for k in range(len(flanges)) if apart[middle, k] <= max(4 * turn, 0.02)]
        if agree == kept or len(agree) < 3 or votes[agree].sum() < 0.6 * votes.sum():
            break
        kept = agree
    return rotation, turn, kept


def _axes(rotation: Array) -> bool:
    """True for a rotation (3, 3) that only exchanges axes, or none."""
    return bool(np.all((np.abs(rotation) < OWN_TURN) | (np.abs(rotation) > 1 - OWN_TURN)))


def angle(a: Array, b: Array) -> float:
    """Angle in rad between two rotations (3, 3)."""
    return math.acos(max(-1.0, min(1.0, 0.5 * (float(np.sum(a * b)) - 1))))


def _shifts(
    flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3], rotation: Array, size: float | None
) -> tuple[Array, float, float, Array]:
    """Distances (n,) in m of the boards' origins from one place, the size of the poses' unit in m with its σ, …

    … and the camera's place (3,) in m in the flange.

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
        return off, size, 0.0, solution[:3] / norms[:3]
    left = float(np.sum((a @ solution + (right * root).ravel()) ** 2)) / max(1, a.shape[0] - a.shape[1])
    sigma = math.sqrt(left * float(np.linalg.pinv(a.T @ a)[-1, -1]))
    return off, float(solution[-1] / norms[-1]), float(sigma / norms[-1]), solution[:3] / norms[:3]


def scaled(pose: pin.SE3, unit: str) -> pin.SE3:
    """The pose with its lengths in m."""
    return from_parts(UNITS[unit] * pose.translation, pose.rotation)
