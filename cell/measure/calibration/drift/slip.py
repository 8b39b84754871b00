"""Has the scan head slipped since the calibration, do its pictures still go with the rail, and was the plate knocked?

The plate on the claw has edges. The rail takes the line over one of them, to and fro: where the line leaves the plate
tells the head's place along the rail, and the difference between the two ways how late the pictures come. The line's
ends tell the head's place across. A verification sees the stripe on the board as well, which tells laser from plate.

Between full verifications every job looks at the fine board once, too. The arm comes to rest a little elsewhere each
time, so one look is blunt: one that chance seldom brings is repeated, and all looks together decide.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy

from cell.measure.calibration.drift.decision import WORST_FIT
from cell.measure.calibration.drift.evidence import (
    INTERIM_VIEW,
    DriftEvidence,
    PictureMeasurements,
    Reference,
    evidence,
)
from cell.measure.calibration.drift.reference_plate import (
    LARGEST_RAD,
    NOTED_RAD,
    ConfirmedTurn,
    PlateLine,
    Pointing,
    turned,
)
from cell.measure.calibration.solve.normal import HAND, PLANE, SHARED, AdjustmentState, tangents
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane, triangulate
from cell.measure.geometry.poses import covariance_root
from drivers.errors import Measured, RefusedError

NOTED_M = 0.05e-3
"""A shift that people are told of: plate, rail and picture that nobody touched give 0.02 mm."""
LARGEST_M = 0.15e-3
NOTED_LAG_S = 2e-3
"""A lag that is told, s: less may come of a picture that is lost as the line leaves the plate."""
LARGEST_LAG_S = 10e-3
"""Pictures that come so much later than at the calibration are paired with the wrong places of the rail."""
PLATE_DEPTH_M = 0.085
LEVER = 1.5
"""What a head that has turned on its mount does at the surface, of what it does at the nearer plate."""
ENDS_DIFFER = 3.0
"""By so many rows more at one end than at the other the line is covered, not shifted."""
RIM_ROWS = 8
"""An end of the line that is so near to the picture's rim is the picture's, not the plate's."""


@dataclass(frozen=True)
class Slip:
    """How far the head has moved against the plate since the calibration: `along` the rail's way and `across` it, m, in
    the camera's frame (across: 0 where an end is not seen, which `hidden` says), and how much later, s, its
    pictures come (`lag`). `depth` is how far the plate is from the camera, m."""

    along: float
    across: float
    lag: float
    hidden: bool = False
    depth: float = PLATE_DEPTH_M

    @property
    def shift(self) -> tuple[float, float]:
        """Along and across, m."""
        return self.along, self.across

    @property
    def size(self) -> float:
        """The whole shift, m."""
        return float(np.hypot(self.along, self.across))

    @property
    def _late(self) -> str:
        return f"{1e3 * abs(self.lag):.1f} ms {'later' if self.lag > 0.0 else 'earlier'}"

    @property
    def lag_open(self) -> float:
        """The lag that is reckoned with, s; 0 where it is too small for a word."""
        return self.lag if abs(self.lag) > NOTED_LAG_S else 0.0

    @property
    def notes(self) -> tuple[str, ...]:
        """For people, what is not as usual."""
        made = []
        if self.size > NOTED_M:
            made.append(
                f"the scan head, or the plate on the claw, has slipped by {1e3 * self.along:+.3f} mm along and "
                f"{1e3 * self.across:+.3f} mm across the rail since the calibration; the stated uncertainty allows for "
                "it. Look at the head's screws, then run `cell calibrate`"
            )
        if self.lag_open:
            made.append(
                f"the scan camera's pictures come {self._late} against the rail's readings than at "
                "the calibration, or the play of its screw is another; the stated uncertainty allows for it. Look at "
                "both, then run `cell calibrate`"
            )
        if self.hidden:
            made.append(
                "whether the scan head has slipped across the rail is not seen: an end of the laser's line on the "
                "plate on the claw is covered or not in the picture. Clean the plate, or take a narrower one"
            )
        return tuple(made)

    def covariance(self, axes: Array, speed: float) -> Array:
        """What a place may be off by because of it, (6, 6), m² and rad², base axes; `axes` (3, 3) are the camera's, and
        `speed` is the sweep's, m/s."""
        made, late = np.zeros((6, 6)), speed * self.lag_open * axes[:, 0]
        made[:3, :3] = np.outer(late, late)
        if self.size > NOTED_M:
            shift = LEVER * (axes @ np.array([self.along, self.across, 0.0]))
            made[:3, :3] += np.outer(shift, shift)
            # A turn on its mount that shifts the plate by as much.
            made[3:, 3:] = (self.size / self.depth) ** 2 * np.eye(3)
        return made

    def require(self) -> None:
        """Raise `RefusedError` for a head that has slipped too far, or pictures that come too late."""
        if not self.size <= LARGEST_M:
            raise RefusedError(
                f"the scan head has slipped by {1e3 * self.along:+.3f} mm along and {1e3 * self.across:+.3f} mm across "
                f"the rail since the calibration, allowed are {1e3 * LARGEST_M:g} mm, or the plate on the claw that "
                "shows it has moved: look at the screws of head and plate, then run `cell calibrate`",
                Measured("scan head slipped by", 1e3 * self.size, "mm", most=1e3 * LARGEST_M),
            )
        if not abs(self.lag) <= LARGEST_LAG_S:
            raise RefusedError(
                f"the scan camera's pictures come {self._late} against the rail's readings than at "
                f"the calibration, allowed are ±{1e3 * LARGEST_LAG_S:g} ms: a sweep would lie elsewhere as a whole. "
                "See whether frames are lost or stamped otherwise (cable, packets, trigger), then run `cell calibrate`",
                Measured("pictures come later by", 1e3 * self.lag, "ms", most=1e3 * LARGEST_LAG_S),
            )


def slip_since(
    before: PlateLine, now: PlateLine, camera: CameraModel, plane: LightPlane, rail_direction: Array
) -> Slip:
    """Between two looks at the plate that both saw its edge, by the calibrated `camera`, light `plane` and the camera's
    motion (3,) per metre of the rail."""
    assert before.edge is not None and now.edge is not None
    both = np.flatnonzero(np.isfinite(before.columns) & np.isfinite(now.columns))
    at = np.column_stack([before.columns[both], both.astype(np.float64)])
    points, _ = triangulate(camera, plane, at)
    depth = float(np.median(points[:, 2]))
    per_px = depth / camera.fx
    # A laser that points elsewhere meets the plate elsewhere, and its edge at another place of the rail.
    by_line = per_px * float(np.median(now.columns[both] - before.columns[both]))
    along = (now.edge.place - before.edge.place) * float(rail_direction[0]) + by_line
    there, was = now.rows[[0, -1]], before.rows[[0, -1]]
    ends = there - was
    beyond = min(there[0], was[0]) < RIM_ROWS or max(there[1], was[1]) >= len(now.columns) - RIM_ROWS
    hidden = bool(beyond or abs(ends[1] - ends[0]) > ENDS_DIFFER)
    # The plate is seen to move against the head; the head has moved the other way.
    across = 0.0 if hidden else -per_px * camera.fx / camera.fy * float(ends.mean())
    return Slip(-along, across, now.edge.lag - before.edge.lag, hidden, depth)


APART = 3.5
"""Standard deviations by which witness and board may differ. Normal errors do so in 0.05 % of all checks."""
_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class WitnessCheck:
    """How far the light plane has turned as the `plate` and as the `board` show it, about the laser's exit. `wrong`
    (27,) is what the scan chain of a job is off by that believes the plate."""

    plate: Pointing
    board: Pointing
    wrong: Array

    @classmethod
    def of(cls, plate: Pointing, exit_point: Array, state: AdjustmentState, weighed: DriftEvidence) -> Self:
        """From what the plate shows and the `weighed` evidence of the board against the calibrated `state`."""
        assert state.plane is not None
        there = turned(state.plane, exit_point, _STEP)
        by_turn = np.zeros(SHARED)
        first, second = tangents(state.plane.n)
        by_turn[PLANE] = first @ there.n, second @ there.n, there.distance - state.plane.distance
        by_turn /= _STEP
        # With the camera's mount free, which one view of the board does not tell from the board's place.
        change, covariance = weighed.change(np.column_stack([by_turn, np.eye(SHARED)[:, HAND]]))
        board = Pointing(float(change[0]), float(np.sqrt(covariance[0, 0])))
        return cls(plate, board, by_turn * (plate.turn - board.turn))

    @property
    def plate_moved(self) -> bool:
        """True when the board contradicts the plate."""
        return abs(self.plate.turn - self.board.turn) > APART * float(np.hypot(self.plate.sigma, self.board.sigma))

    @property
    def corrects(self) -> bool:
        """True when the laser has turned, as the board says, too, so that jobs are right to allow for it."""
        return abs(self.plate.turn) > NOTED_RAD and not self.plate_moved

    def confirmation(self, made: float) -> ConfirmedTurn | None:
        """The turn as the board measured it, to be kept for jobs; `made` in seconds since the epoch.

        None where there is nothing to confirm, or the board is no judge: it contradicts the plate, tells less than a
        job needs, or shows more than warmth does to a laser.
        """
        board = self.board
        if not self.corrects or board.sigma > NOTED_RAD or abs(board.turn) > LARGEST_RAD:
            return None
        return ConfirmedTurn(self.plate.turn, board.turn, board.sigma, made)

    @property
    def words(self) -> str:
        """Both figures."""
        return (
            f"{1e3 * self.plate.turn:+.2f} ± {1e3 * self.plate.sigma:.2f} mrad by the plate on the claw, "
            f"{1e3 * self.board.turn:+.2f} ± {1e3 * self.board.sigma:.2f} mrad by the board"
        )

    def as_dict(self) -> dict[str, object]:
        """For reports."""
        figures = {"plate": self.plate, "board": self.board}
        made = {f"{name}_mrad": round(1e3 * one.turn, 4) for name, one in figures.items()}
        made |= {f"{name}_sigma_mrad": round(1e3 * one.sigma, 4) for name, one in figures.items()}
        return {**made, "plate_moved": self.plate_moved}


SUSPICIOUS = 0.1
"""Looks that chance brings more seldom are repeated: one job in ten, of a head that nobody touched."""
CHANCE = 1e-4
"""What chance brings more seldom is a change. Jobs of one calibration share its error: false alarms come together."""


@dataclass(frozen=True, eq=False)
class HeadShift:
    """By how much the scan head has moved on the flange since its calibration, as the fine board shows it.

    `change` (6,) is flange_from_camera's: m along the flange's axes, then rad about them. `covariance` (6, 6) holds
    noise, the arm's rests and the calibration's own. `dots` is the RMS of the dots' whitened residuals, 1 as
    calibrated. `chance` is the probability of so much without any change, `looks` how often the arm came to rest.
    """

    change: Array
    covariance: Array
    dots: float
    chance: float
    looks: int

    @classmethod
    def of(cls, state: AdjustmentState, reference: Reference, looks: Sequence[PictureMeasurements]) -> Self:
        """From pictures of the board, each from a rest of its own in `INTERIM_VIEW`, beside the calibrated `state`. A
        head that slipped is shifted or turned, seldom both, so each is held against chance by itself."""
        weighed = evidence(state, reference, looks, INTERIM_VIEW)
        hand = np.eye(SHARED)[:, HAND]
        change, covariance = weighed.change(hand)
        score, information = hand.T @ weighed.score, hand.T @ weighed.information @ hand
        squares = [
            score[part] @ np.linalg.solve(information[part, part], score[part]) for part in (slice(0, 3), slice(3, 6))
        ]
        chance = min(1.0, 2.0 * float(scipy.special.chdtrc(3, max(squares))))
        return cls(change, covariance, weighed.dots, chance, len(looks))

    @property
    def suspicious(self) -> bool:
        """Whether to look again."""
        return self.chance < SUSPICIOUS

    @property
    def changed(self) -> bool:
        """Whether chance does not bring so much."""
        return self.chance < CHANCE

    @property
    def fits(self) -> bool:
        """Whether the pictures show the board as flat and sharp as at the calibration."""
        return self.dots <= WORST_FIT

    @property
    def likely(self) -> Array:
        """The most likely change (27,) of the chain's parameters."""
        made = np.zeros(SHARED)
        made[HAND] = self.change
        return made

    def drawn(self, count: int) -> Array:
        """Changes (count, 27) of the chain's parameters as likely as this one, always the same ones."""
        made = np.zeros((count, SHARED))
        root = covariance_root(self.covariance)
        made[:, HAND] = self.change + np.random.default_rng(0).normal(size=(count, root.shape[1])) @ root.T
        return made
