"""The interim check: before each job moves its part, the scan camera looks at the fine board on the deck.

The view is one of the calibration's own, with the same joints, so that the arm's kinematic error is the same. What a
turned mount, a joint with a new zero or a bumped board does, shows alike: the board is not where the calibration has
it.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Self

import numpy as np
import pinocchio as pin

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.devices.devices import Devices
from cell.measure.calibration import ScanObservation
from cell.measure.calibration.drift.decision import WORST_FIT
from cell.measure.calibration.drift.evidence import PictureMeasurements, dots_of
from cell.measure.calibration.drift.slip import HeadShift
from cell.measure.geometry.poses import from_parts, from_ur
from cell.measure.vision.board.view import parse_board
from cell.procedures.arm.moves import Mover
from cell.procedures.arm.photograph import NO_REFERENCE, CalibrationView, interim_view
from cell.procedures.calibrate.boards import PHOTO_RATE, Keep, look_for
from cell.procedures.calibrate.verification import DRAWS, SHARE, SURE, at_place
from cell.procedures.sweep.sweeping import beside_arm
from drivers.errors import CalibrationStale, Measured, RefusedError
from drivers.interfaces import Vector

LOOKS = 4
"""So often the arm comes to rest at most. More would not be sharper: the calibration's own error remains."""
MOVED = "place off by what has moved, bound"
CAUSES = "the scan head on the flange, a joint's zero, or the fine board on the deck"


@dataclass(frozen=True, eq=False)
class InterimCheck:
    """What the look at the board says of the `head`, and what that does at the place of a job, m.

    `effect` is what the change found does there, `at_most` what it does in `SURE` of cases. `tolerance` is the place's.
    `off` (3,) is by how much, and `sigma` (3,) one standard deviation of it, a point in the middle of a sweep is moved,
    along the flange's axes.
    """

    head: HeadShift
    effect: float
    at_most: float
    tolerance: float
    off: Vector
    sigma: Vector

    @classmethod
    def of(
        cls, config: CellConfig, calibration: CellCalibration, job: Job, looks: Sequence[ScanObservation]
    ) -> Self:  # fmt: skip
        """From photographs of the fine board, each from a rest of its own; raises what `interim_view` raises."""
        scan = calibration.scan
        # A head that turns takes its rail along: what counts is where it stands in the middle of a sweep.
        middle = 0.5 * sum(config.rail.travel)
        near = scan.reference
        if near is None:
            raise CalibrationStale(NO_REFERENCE)
        seen = [PictureMeasurements(dots_of(look), k, k) for k, look in enumerate(looks)]
        head = HeadShift.of(scan.state(near.base_from_board), near, seen)
        does = at_place(calibration, job, middle)
        effects = [does("scan", change) for change in head.drawn(DRAWS)]
        seen_at = middle * scan.rail_direction + np.array([0.0, 0.0, job.scan.stand_off])
        ahead = scan.flange_from_camera.rotation @ seen_at
        moves = np.hstack([np.eye(3), -pin.skew(ahead)])
        sigma = np.sqrt(np.diag(moves @ head.covariance @ moves.T))
        return cls(
            head, does("scan", head.likely), float(np.quantile(effects, SURE)), job.place.tolerance,
            off=moves @ head.change, sigma=sigma,
        )  # fmt: skip

    @property
    def allowed(self) -> float:
        """What a moved head may do at the place at most, m: a `SHARE` of its tolerance."""
        return SHARE * self.tolerance

    @property
    def matters(self) -> bool:
        """Whether what has changed may move the place by more than is allowed."""
        return self.head.changed and self.at_most >= self.allowed

    def require(self) -> None:
        """Raise `RefusedError` where the head has moved so far that it matters, or the pictures do not fit."""
        dots, allowed = self.head.dots, 1e3 * self.allowed
        if not self.head.fits:
            raise RefusedError(
                f"the fine board on the deck fits its picture {dots:.1f} times worse than at the calibration, allowed "
                f"{WORST_FIT:g} times: see whether board and lens are clean, the board flat and the lens in focus, "
                "then run `cell calibrate verify`",
                Measured("fine board's misfit, over the calibration's", dots, most=WORST_FIT),
            )
        if self.matters:
            at_most = Measured(MOVED, 1e3 * self.at_most, "mm", most=allowed)
            text = f"{self.words}; allowed are {allowed:.2f} mm. See what is loose or was bumped"
            raise RefusedError(f"{text}, then run `cell calibrate`", at_most)

    @property
    def words(self) -> str:
        """What has moved, for people."""
        x, y, z, *turns = 1e3 * self.head.change
        turned = ", ".join(f"{turn:+.2f}" for turn in turns)
        return (
            f"since the calibration {CAUSES} has moved: by ({x:+.2f}, {y:+.2f}, {z:+.2f}) mm and ({turned}) mrad in "
            f"the flange's axes. That puts the place {1e3 * self.effect:.2f} mm off, at most "
            f"{1e3 * self.at_most:.2f} mm"
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """For people: a change that matters too little to end the job, or what this look could not have shown."""
        if self.head.changed:
            return () if self.matters else (f"{self.words}: the job goes on. Run `cell calibrate` when there is time",)
        if self.at_most < self.allowed:
            return ()
        return (
            f"the look at the fine board is blunt here: what it leaves open may put the place {1e3 * self.at_most:.2f} "
            f"mm off (allowed {1e3 * self.allowed:.2f} mm). `cell calibrate verify` looks more closely",
        )

    def summary(self) -> dict[str, object]:
        """Figures for journal and report."""
        change, sigma = 1e3 * self.head.change, 1e3 * np.sqrt(np.diag(self.head.covariance))
        return {
            "shift_mm": [round(float(v), 4) for v in change[:3]],
            "turn_mrad": [round(float(v), 4) for v in change[3:]],
            "sigma_mm": [round(float(v), 4) for v in sigma[:3]], "sigma_mrad": [round(float(v), 4) for v in sigma[3:]],
            "place_mm": round(1e3 * self.effect, 4), "place_at_most_mm": round(1e3 * self.at_most, 4),
            "place_allowed_mm": round(1e3 * self.allowed, 4),
            "off_mm": [round(1e3 * float(v), 4) for v in self.off],
            "off_sigma_mm": [round(1e3 * float(v), 4) for v in self.sigma],
            "dots": round(self.head.dots, 3), "chance": self.head.chance, "looks": self.head.looks,
            "changed": self.head.changed,
        }  # fmt: skip


def fine_board_view(config: CellConfig, calibration: CellCalibration) -> CalibrationView:
    """From where the check looks; raises what `interim_view` raises."""
    return interim_view(config, parse_board(config.calibration.fine.board), calibration.scan)


OVER_M = 0.2
"""So far above its view of the board the arm rests between jobs: there is room to put a part into the claw."""


def resting_pose(view: CalibrationView) -> pin.SE3:
    """base_from_flange for an arm that waits for its next job: over the board, at which that job looks first."""
    return from_parts((0.0, 0.0, OVER_M)) * view.base_from_flange


def interim_check(
    config: CellConfig, devices: Devices, mover: Mover, calibration: CellCalibration, job: Job, *,
    check: Callable[[], None], progress: Callable[[str], None], keep: Keep,
) -> InterimCheck:  # fmt: skip
    """Look at the fine board; again, from where the arm rests, for as long as it may show chance or a change.

    Raises `CalibrationStale` for a calibration without its reference, `RefusedError` when the board is not seen, and
    what `Mover.to_view` raises where its view is out of reach.
    """
    fine, view = parse_board(config.calibration.fine.board), fine_board_view(config, calibration)
    rail = devices.rail
    devices.scan_camera.configure(config.scan_camera.photo_exposure, PHOTO_RATE)
    looks: list[ScanObservation] = []
    while True:
        check()
        progress("looking at the fine board" + (", again" if looks else ""))
        begin = partial(rail.move_to, view.rail_position) if rail.state().homed_here else rail.home
        with beside_arm(mover, rail, begin):
            mover.to_view(view.base_from_flange)
        rail.move_to(view.rail_position).wait(30.0)
        refusals = Counter[str]()
        seen = look_for(devices.scan_camera, fine, refusals, keep, f"interim-{len(looks) + 1}")
        if seen is None:
            raise RefusedError(
                f"the fine board on the deck is not seen where the calibration has it: {next(iter(refusals))}. Clean "
                "it, see that nothing covers it and that light and lens are as they were, then run the job again; "
                "where board, camera or arm were moved, run `cell calibrate` first"
            )
        flange = from_ur(devices.arm.state().flange)
        looks.append(ScanObservation(seen, None, flange, rail.state().position))
        found = InterimCheck.of(config, calibration, job, looks)
        if len(looks) == LOOKS or found.head.changed or not found.head.suspicious:
            return found
        # From where it rests: over a shorter way friction brings the arm back to the very place that it just had.
        mover.fold()
