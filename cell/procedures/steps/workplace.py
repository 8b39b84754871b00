"""Where a job is done: one cell's configuration, calibration and devices, the job's surface, and the run's folder."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import CellConfig
from cell.config.job import BoardSection, Job
from cell.devices.devices import Devices
from cell.measure.calibration.drift.reference_plate import Pointing
from cell.measure.calibration.drift.slip import Slip
from cell.measure.inversion import NominalSurface
from cell.measure.vision.board.view import BoardSpec, parse_board
from cell.procedures.ambient import in_any_light
from cell.procedures.arm.moves import Mover, Pace, PartProgress, PartState
from cell.procedures.arm.photograph import APART_S, BoardFix, photograph
from cell.procedures.calibrate.interim import InterimCheck, fine_board_view, resting_pose
from cell.procedures.drive.way import Whereabouts
from cell.procedures.frame_store import FrameStore
from cell.procedures.grasp import GraspSeries
from cell.procedures.sweep.swath import SweepCollector
from drivers.errors import CalibrationStale
from drivers.interfaces import Vector
from statemachine.runner import StepContext
from statemachine.step import Step

if TYPE_CHECKING:
    from cell.procedures.steps.drive_to_target import VehicleArrival
    from cell.procedures.steps.pick import HeldPart
    from cell.procedures.sweep.stored_sweep import StoredSweep


CHANCE_SCATTER = 1.3
"""Found over configured scatter of the arm that the few views of a calibration show by chance."""
PHOTO_RATE_HZ = 10.0
"""Frame rate while the station's board is photographed."""


AGAIN_S = 600.0
"""So long, s of the cell, a batch goes on by one look at the boards on deck and claw, where its placed parts are looked
at: what creeps creeps little, and a scan head that was bumped shows in where they lie."""


@dataclass(frozen=True, eq=False)
class HeadLook:
    """What the plate on the claw told of laser and scan head, and that the fine board was looked at: `at`, s of the
    cell's clock."""

    at: float
    pointing: Pointing | None
    slip: Slip | None


@dataclass(frozen=True, eq=False)
class PartsBefore:
    """What the parts before this one of its batch tell: how they came to lie, and where the vehicle has stood since
    the last of them, None where it or the station may have been moved.

    `board` is where the station's board was then, `look` when the scan head was looked at, None where it has to be
    anew. `touch_off` is how far, m, from where it should the last of them touched first. `more` says that another part
    follows by itself.
    """

    series: GraspSeries = field(default_factory=GraspSeries)
    arrival: VehicleArrival | None = None
    board: BoardFix | None = None
    look: HeadLook | None = None
    touch_off: float | None = None
    more: bool = False


@dataclass(eq=False)
class Workplace:
    """What every step of a job may use.

    `job` changes once: a pick from a nest replaces its grasp by the measured one. `earlier` is the sweep of a run that
    this one resumes, `held` how that had gripped its part. `needs_part`: the claw must hold the part at the beginning.
    `looks_again` is True for a run that looks at the surface once more after its sweep, `looks_after` for one that
    looks at the placed part. `shares_look`: a scan head that was bumped shows in what the run sees of that part, so it
    may go by a look at the head for a part before. `retried` says whether a step had to be done again. `whereabouts` is
    kept over retries and runs: the vehicle may stand anywhere when a step is done again. `sweeping` is told who takes
    the frames of each sweep, before it begins, and where the surface is by the board (base_from_surface), `registered`
    where it was found. `pace` is the share of the planned speed. `looked` says whether this run has tried to look at
    the fine board, `interim` what that said, None where nothing was to be seen. `ground` is the box around the surface
    below a part to be unloaded, its lowest and highest corner, m, part frame. `parts_before` is what the parts before
    this one of its batch tell.
    """

    config: CellConfig
    job: Job
    nominal: NominalSurface
    calibration: CellCalibration
    devices: Devices
    frames: FrameStore
    folder: Path
    whereabouts: Whereabouts
    earlier: StoredSweep | None = None
    held: HeldPart | None = None
    needs_part: bool = True
    looks_again: bool = False
    looks_after: bool = False
    shares_look: bool = False
    retried: bool = False
    sweeping: Callable[[SweepCollector, pin.SE3], None] = lambda collector, base_from_surface: None
    registered: Callable[[pin.SE3], None] = lambda base_from_surface: None
    part: PartProgress = field(default_factory=PartProgress)
    pace: Pace = field(default_factory=Pace)
    interim: InterimCheck | None = None
    looked: bool = False
    ground: tuple[Vector, Vector] | None = None
    parts_before: PartsBefore = field(default_factory=PartsBefore)
    _photographs: int = field(default=0, init=False)

    @cached_property
    def mover(self) -> Mover:
        """Planned moves of the arm with the job's part in the claw. It rests where the next job looks first."""
        devices = self.devices
        made = Mover(devices.arm, devices.clock, self.config, self.job, interlocks=devices.interlocks, pace=self.pace)
        if self.part.state.untaken:
            made.empty_claw()
        if self.part.state is PartState.NESTED and self.job.nest is not None:
            made.avoid_part(self.job.nest.base_from_part.se3(), self.job.grasp.size)
        if self.config.calibration.each_job:
            with suppress(CalibrationStale):
                rest = resting_pose(fine_board_view(self.config, self.calibration))
                made.rest_at(rest)
                devices.interlocks.may_drive_with("over the fine board", rest)
        return made

    @cached_property
    def board(self) -> BoardSpec:
        """The station's board."""
        return parse_board(self.job.board.spec)

    @cached_property
    def part_mesh(self) -> NominalSurface | None:
        """The job's part as drawn, in its own frame; None where the job names no mesh of it."""
        part = self.job.part
        return None if part is None else NominalSurface.load(Path(part.mesh), unit=part.mesh_unit)

    def base_from_surface(self, fix: BoardFix) -> pin.SE3:
        """Where the surface is by the board."""
        return fix.base_from_board * self.job.place_from_board.inverse() * self.job.surface.place_from_surface.se3()

    def look_before(self, context: StepContext) -> HeadLook | None:
        """The look at the scan head that a part before this one had, if this one may go by it: none after a hold or a
        fault of this run either."""
        look = self.parts_before.look if self.shares_look and not self.retried and not context.held_s else None
        return look if look is not None and self.devices.clock.now() - look.at < AGAIN_S else None

    @property
    def repeatability(self) -> Vector:
        """Covariance (6, 6) of base_from_flange each time the arm comes to rest, m² and rad²."""
        arm = self.config.arm
        return self._scattered(arm.repeatability, arm.repeatability_angle)

    @property
    def settling(self) -> Vector:
        """Covariance (6, 6) of base_from_flange for an arm that stands still, m² and rad²: what creeps and warms up
        meanwhile is as much, at most, as configured of its repeatability."""
        arm = self.config.arm
        return np.diag([arm.repeatability**2] * 3 + [arm.repeatability_angle**2] * 3)

    @property
    def kinematic(self) -> Vector:
        """Covariance (6, 6) of a measured place in the base that the arm realises when it goes there, m² and rad²."""
        arm = self.config.arm
        return self._scattered(arm.kinematic_sigma, arm.kinematic_sigma_angle)

    @property
    def notes(self) -> tuple[str, ...]:
        """For people: what of the arm is not as configured."""
        if self._scatter == 1.0:
            return ()
        return (
            f"in the calibration the arm's poses scattered {self._scatter:.1f} times as much as arm.repeatability says "
            "(uneven gears, that is joint harmonics, or sag, or lengths that its controller does not know); as much is "
            "stated of sweep and place",
        )

    def _scattered(self, translation: float, rotation: float) -> Vector:
        """What is configured, as far as the calibration bore it out; more scatter comes from the joints. The same angle
        of a joint moves the flange the farther the farther the arm reaches out."""
        angle = self._scatter
        shift = angle if angle == 1.0 else angle * self._farther_out
        return np.diag([(shift * translation) ** 2] * 3 + [(angle * rotation) ** 2] * 3)

    @property
    def _farther_out(self) -> float:
        """How many times as far as over the calibration board the arm reaches out over the place; at least 1."""
        place_from_base = self.job.approach.target.se3() * self.config.arm.vehicle_from_base.se3()
        board = self.config.calibration.fine.base_from_board.se3()
        return max(1.0, float(np.linalg.norm(place_from_base.translation) / np.linalg.norm(board.translation)))

    @property
    def _scatter(self) -> float:
        """How many times as much as configured the arm scattered in the calibration; 1 where chance explains it."""
        arm, found = self.config.arm, self.calibration.scan.reference
        if found is None:
            return 1.0
        ratio = max(found.arm_translation / arm.repeatability, found.arm_rotation / arm.repeatability_angle)
        return ratio if ratio > CHANCE_SCATTER else 1.0

    def photograph(self, count: int = 1) -> BoardFix:
        """The station's board from `count` photographs by the target camera; see `cell.procedures.arm.photograph`."""
        # Numbered, since a camera may count its frames anew: a later photograph must not take an earlier one's place.
        self._photographs += 1
        what = f"board-{self._photographs:02d}"
        camera = self.devices.target_camera
        fix = in_any_light(camera, lambda: photograph(
            self.devices.arm, camera, self.calibration.target, spec=self.board,
            limits=self.job.photo, repeatability=self.repeatability, count=count,
            keep=lambda frame: self.frames.keep(what, frame), pause=lambda: self.devices.clock.sleep(APART_S),
        ))  # fmt: skip
        self.frames.found = fix.frames[-1], fix.views[-1].pixels
        if self.devices.following is not None:
            self.devices.following.board_seen(fix.base_from_board)
        return replace(fix, number=self._photographs)

    def photograph_of(self, board: BoardSection) -> BoardFix:
        """The board of another stop, in one photograph from where the arm stands."""
        return photograph(
            self.devices.arm, self.devices.target_camera, self.calibration.target, spec=parse_board(board.spec),
            limits=self.job.photo, repeatability=self.repeatability,
        )  # fmt: skip

    def keep_again(self, fix: BoardFix) -> BoardFix:
        """A photograph of the run before this one, its frames kept as if this one had made it."""
        self._photographs += 1
        for frame in fix.frames:
            self.frames.keep(f"board-{self._photographs:02d}", frame)
        self.frames.found = fix.frames[-1], fix.views[-1].pixels
        return replace(fix, number=self._photographs)


@dataclass(frozen=True)
class JobStep:
    """`work(workplace, context)` returns a `makes`; it takes what it `needs`, by type, with `context.made(type)`."""

    policy: Step
    work: Callable[[Workplace, StepContext], object]
    makes: type
    needs: tuple[type, ...] = ()

    @property
    def name(self) -> str:
        """The step's name, in reports and on the command line."""
        return self.policy.name
