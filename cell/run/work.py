"""The six steps of one job, bound to one cell's devices: takes each step's inputs from the earlier results.

Here a step's context meets its function; what a step does is in `cell.steps`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from cell.calibration.store import CellCalibration
from cell.config import CellConfig
from cell.devices.assembly import Devices
from cell.geometry.poses import to_ur
from cell.inversion import NominalSurface, PlacePose
from cell.job import Job, ScanSection
from cell.run.frames import FrameStore
from cell.steps.board_photo import board_photo
from cell.steps.camera_poses import look_pose, photo_pose, scan_plans
from cell.steps.drive_to_target import Arrival, drive_to_target
from cell.steps.invert_pose import invert_pose
from cell.steps.laser_sweep import SweepRecord, laser_sweep
from cell.steps.moves import HOME, Mover
from cell.steps.photograph import BoardFix, photograph
from cell.steps.place import PartProgress, PlaceResult, place
from cell.steps.reconstruct import Reconstruction, reconstruct
from cell.steps.stored_sweep import StoredSweep, save_sweep
from cell.steps.swath import SweepErrors
from cell.steps.whereabouts import Whereabouts
from cell.vision import parse_board
from drivers.errors import CalibrationStale, RefusedError
from drivers.interfaces import Vector
from statemachine.runner import StepContext

CHANCE_SCATTER = 1.3
"""Found over configured scatter of the arm that the few views of a calibration show by chance."""

SHIFT_SHARE = 0.25
"""Share of the place's tolerance by which the unknown of its times may shift a sweep. Replies that are all late shift
it to one side without any scatter; what else the place may be off by has the other three quarters.
"""


def unhurried(scan: ScanSection, attempt: int) -> ScanSection:
    """The sweep of the `attempt` (from 1): each repetition half as fast with half the frames, the lines as close.

    What loses frames most often is a machine that does not keep up with them.
    """
    share = 0.5 ** (attempt - 1)
    return scan.model_copy(update={"speed": share * scan.speed, "frame_rate": max(1.0, share * scan.frame_rate)})


class JobWork:
    """What the runner calls, a method a step; results travel in the step context."""

    def __init__(
        self,
        config: CellConfig,
        job: Job,
        nominal: NominalSurface,
        calibration: CellCalibration,
        devices: Devices,
        frames: FrameStore,
        folder: Path,
        whereabouts: Whereabouts,
        earlier: StoredSweep | None = None,
    ) -> None:
        self._config = config
        self._job = job
        self._nominal = nominal
        self._calibration = calibration
        self._devices = devices
        self._frames = frames
        self._folder = folder
        self._board = parse_board(job.board.spec)
        self._mover = Mover(devices.arm, devices.clock, config, job)
        self._earlier = earlier
        self._photographs = 0
        # Kept over retries and runs: the vehicle may stand anywhere when the step is done again.
        self._whereabouts = whereabouts
        self.part = PartProgress()

    def steps(self) -> dict[str, Callable[[StepContext], object]]:
        """The work by step name; each attempt enters the gate anew."""
        steps = (
            self.drive_to_target,
            self.board_photo,
            self.laser_sweep,
            self.reconstruct,
            self.invert_pose,
            self.place,
        )
        return {step.__name__: partial(self._enter, step) for step in steps}

    def _enter(self, step: Callable[[StepContext], object], context: StepContext) -> object:
        self._devices.gate.enter(context.token)
        context.check()
        self._mover.hold = context.safe_point
        self._frames.begin()
        return step(context)

    def drive_to_target(self, context: StepContext) -> Arrival:
        """See `cell.steps.drive_to_target`."""
        context.progress(0.0, "arm to the looking pose")
        if not self._devices.claw.holding:
            raise RefusedError(
                f"the claw holds no part: put the part of job {self._job.job.name} into it, or see whether it was "
                "placed already"
            )
        vehicle = self._devices.vehicle
        if trouble := vehicle.state().trouble:
            context.note(text=f"the vehicle reported before the run: {'; '.join(trouble)}; taking command clears it")
        vehicle.enable()
        vehicle.brake()
        if not self._whereabouts.anchored:
            self._mover.to_joints(HOME)
        self._whereabouts.enter(self._job)
        camera = self._calibration.target.flange_from_camera
        self._mover.to(look_pose(self._config, self._job, self._board, camera), "the looking pose")
        self._devices.target_camera.configure(self._config.target_camera.photo_exposure, 10.0)
        vehicle.enable()
        return drive_to_target(
            self._job,
            self._config.arm.vehicle_from_base.se3(),
            vehicle,
            self._whereabouts,
            self._photograph,
            self._devices.clock,
            context.check,
            context.progress,
            lambda text: context.note(text=text),
            context.safe_point,
        )

    def board_photo(self, context: StepContext) -> BoardFix:
        """See `cell.steps.board_photo`."""
        arrival = cast(Arrival, context.results["drive_to_target"])
        self._mover.meet_station(arrival.base_from_place, self._job, self._board, self._nominal.extent)
        goal = photo_pose(
            self._job, self._board, arrival.fix.base_from_board, self._calibration.target.flange_from_camera
        )
        self._devices.target_camera.configure(self._config.target_camera.photo_exposure, 10.0)
        return board_photo(goal, self._mover, self._photograph, self._job.photo.count, context.progress)

    def laser_sweep(self, context: StepContext) -> SweepRecord:
        """See `cell.steps.laser_sweep`; not swept again what an earlier run has swept, if the board has not moved."""
        fix = cast(BoardFix, context.results["board_photo"])
        if self._earlier is not None:
            try:
                sweep = self._earlier.confirmed_by(fix)
            except CalibrationStale as moved:
                context.note(text=f"{moved}: sweeping again")
            else:
                self._earlier.copy_to(self._folder)
                context.note(text=f"the board has not moved: the sweep of run {self._earlier.folder.name} holds")
                return sweep
        sweep = self._sweep(context, fix)
        save_sweep(self._folder, sweep, fix)
        return sweep

    def _sweep(self, context: StepContext, fix: BoardFix) -> SweepRecord:
        base_from_place = fix.base_from_board * self._job.place_from_board.inverse()
        base_from_surface = base_from_place * self._job.surface.place_from_surface.se3()
        devices = self._devices
        if not devices.rail.state().homed_here:
            context.progress(0.0, "homing the rail")
            devices.rail.home().wait(60.0)
        return laser_sweep(
            scan_plans(self._config, self._job, base_from_surface, self._calibration.scan),
            unhurried(self._job.scan, context.attempt),
            self._calibration.scan.geometry(),
            SweepErrors(
                self.repeatability,
                self._config.calibration.rail_sigma,
                SHIFT_SHARE * self._job.place.tolerance,
                devices.clock.rate,
            ),
            self._mover,
            devices,
            lambda frame: self._frames.keep("stripe", frame),
            context.check,
            context.progress,
        )

    def reconstruct(self, context: StepContext) -> Reconstruction:
        """See `cell.steps.reconstruct`."""
        sweep = cast(SweepRecord, context.results["laser_sweep"])
        return reconstruct(
            sweep,
            self._calibration.scan,
            self._job.scan.largest_hole,
            self._folder / "cloud.ply",
            self._config.arm.vehicle_from_base.se3().inverse(),
            self._config.vehicle.lean_sigma,
        )

    def invert_pose(self, context: StepContext) -> PlacePose:
        """See `cell.steps.invert_pose`."""
        fix = cast(BoardFix, context.results["board_photo"])
        scan = cast(Reconstruction, context.results["reconstruct"])
        return invert_pose(scan, fix, self._job, self._nominal, self.kinematic)

    def place(self, context: StepContext) -> PlaceResult:
        """See `cell.steps.place`."""
        pose = cast(PlacePose, context.results["invert_pose"])
        return place(
            self._job,
            pose.base_from_surface,
            self._mover,
            self._devices.arm,
            self._devices.claw,
            self.part,
            context.check,
            context.progress,
            lambda part: context.note(part=part.state.value, base_from_part=to_ur(part.where).tolist()),
        )

    @property
    def repeatability(self) -> Vector:
        """Covariance (6, 6) of base_from_flange each time the arm comes to rest, m² and rad²."""
        arm = self._config.arm
        return self._scatter**2 * np.diag([arm.repeatability**2] * 3 + [arm.repeatability_angle**2] * 3)

    @property
    def kinematic(self) -> Vector:
        """Covariance (6, 6) of a measured place in the base that the arm realises when it goes there, m² and rad²."""
        arm = self._config.arm
        return self._scatter**2 * np.diag([arm.kinematic_sigma**2] * 3 + [arm.kinematic_sigma_angle**2] * 3)

    @property
    def _scatter(self) -> float:
        """How many times as much as configured the arm scattered in the calibration; 1 where chance explains it."""
        arm, found = self._config.arm, self._calibration.scan.reference
        if found is None:
            return 1.0
        ratio = max(found.arm_translation / arm.repeatability, found.arm_rotation / arm.repeatability_angle)
        return ratio if ratio > CHANCE_SCATTER else 1.0

    def _photograph(self, count: int = 1) -> BoardFix:
        # Numbered, since a camera may count its frames anew: a later photograph must not take an earlier one's place.
        self._photographs += 1
        what = f"board-{self._photographs:02d}"
        return photograph(
            self._devices.arm,
            self._devices.target_camera,
            self._calibration.target,
            self._board,
            self._job.photo,
            self.repeatability,
            count,
            lambda frame: self._frames.keep(what, frame),
        )
