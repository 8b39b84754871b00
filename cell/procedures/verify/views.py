"""Verifying the calibration: one view of each deck board, approached several times, and one sweep over the fine board.

The views are the calibration's own, aimed with what it found: near enough to its poses that the arm's kinematic error
is the same. Approaching them anew averages the arm's repeatability. In each approach the scan camera photographs its
board from both ends of the way that the rail can go with the board in view.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pinocchio as pin

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import CellConfig
from cell.config.job import ScanSection
from cell.devices.devices import Devices
from cell.measure.calibration import ScanObservation, TargetObservation
from cell.measure.calibration.drift.reference_plate import turn_seen
from cell.measure.geometry.poses import from_ur
from cell.measure.reconstruction import ScanGeometry
from cell.measure.vision import BoardSpec, BoardView, StripeProfile, parse_board
from cell.motion.arm_models import HOME
from cell.procedures.arm.camera_poses import CalibrationView, ScanPlan, rail_ends, verification_views
from cell.procedures.arm.moves import Mover
from cell.procedures.calibrate.boards import PHOTO_RATE, Check, Keep, Progress, look_for, move_to_view
from cell.procedures.calibrate.reference_plate import require_witness
from cell.procedures.sweep.rail_sweep import rail_sweep
from cell.procedures.sweep.swath import SweepCollector, SweepErrors, rehearse
from cell.procedures.verify.looks import CheckObservations
from drivers.errors import RefusedError
from drivers.interfaces import Camera, Frame

SCAN_APPROACHES, TARGET_APPROACHES = 2, 6
BACK_M = 0.02
"""How far the flange leaves a view, each time another way, before it approaches it again."""
SWEEP_SPEED, SWEEP_RATE = "12 mm/s", "10 Hz"
MAX_SHIFT = 0.15e-3
"""Farthest, in m, that the sweep may lie off because of its times: less than the changes that are looked for."""


def collect_verification(
    config: CellConfig,
    devices: Devices,
    mover: Mover,
    calibration: CellCalibration,
    check: Check,
    progress: Progress,
    keep: Keep,
) -> CheckObservations:
    """Take all pictures; each goes to `keep`.

    Raises `RefusedError` when a board or the laser's witness is not seen, `CalibrationStale` without a reference.
    """
    fine, large = parse_board(config.calibration.fine.board), parse_board(config.calibration.large.board)
    scan_view, target_view = verification_views(config, fine, large, calibration.scan, calibration.target)
    assert calibration.scan.reference is not None
    base_from_board = calibration.scan.reference.base_from_board
    ends = rail_ends(calibration.scan, base_from_board, scan_view, fine, config.rail.travel)
    if not devices.rail.state().homed_here:
        progress(0.0, "homing the rail")
        devices.rail.home().wait(60.0)
    mover.to_joints(HOME)
    pointing = None
    if calibration.scan.witness is not None:
        progress(0.0, "looking where the laser points")
        head, now = calibration.scan, require_witness(config, devices, keep)
        pointing = turn_seen(calibration.scan.witness, now, head.camera, head.light_plane, config.laser.exit_point)
    photographs: list[list[ScanObservation]] = []
    sweep: list[ScanObservation] = []
    for k in range(SCAN_APPROACHES):
        check()
        progress(0.6 * k / SCAN_APPROACHES, f"fine board, approach {k + 1} of {SCAN_APPROACHES}")
        if k:
            move_to_view(devices, mover, _beside(scan_view, k), k)
        if k == SCAN_APPROACHES - 1:
            sweep = _sweep(
                config,
                devices,
                mover,
                geometry=calibration.scan.geometry(),
                view=scan_view,
                ends=ends,
                progress=lambda f, t: progress(0.3 + 0.2 * f, t),
                keep_frame=lambda frame: keep("stripe", frame),
            )
        else:
            move_to_view(devices, mover, scan_view, k)
        photographs.append(_photographs(config, devices, fine, ends=ends, keep=keep, what=f"fine-{k + 1}"))
    target: list[TargetObservation] = []
    devices.target_camera.configure(config.target_camera.photo_exposure, PHOTO_RATE)
    for k in range(TARGET_APPROACHES):
        check()
        progress(0.6 + 0.4 * k / TARGET_APPROACHES, f"large board, approach {k + 1} of {TARGET_APPROACHES}")
        if k:
            move_to_view(devices, mover, _beside(target_view, k), k)
        move_to_view(devices, mover, target_view, k)
        seen = _found(devices.target_camera, large, "large", keep, f"large-{k + 1}")
        target.append(TargetObservation(seen, from_ur(devices.arm.state().flange), f"large {k + 1}"))
    return CheckObservations(photographs, sweep, target, pointing, config.laser.exit_point)


def _photographs(
    config: CellConfig, devices: Devices, board: BoardSpec, ends: tuple[float, float], keep: Keep, what: str
) -> list[ScanObservation]:
    devices.scan_camera.configure(config.scan_camera.photo_exposure, PHOTO_RATE)
    made = []
    for end, side in zip(ends, "ab", strict=True):
        devices.rail.move_to(end).wait(30.0)
        seen = _found(devices.scan_camera, board, "fine", keep, what + side)
        flange = from_ur(devices.arm.state().flange)
        made.append(ScanObservation(seen, None, flange, devices.rail.state().position))
    return made


def _sweep(
    config: CellConfig,
    devices: Devices,
    mover: Mover,
    geometry: ScanGeometry,
    view: CalibrationView,
    ends: tuple[float, float],
    progress: Callable[[float, str], None],
    keep_frame: Callable[[Frame], None],
) -> list[ScanObservation]:
    """To the view and over the board's plate from end to end."""
    section = ScanSection.model_validate(
        {
            "stand_off": "130 mm",
            "length": f"{1e3 * (ends[1] - ends[0])} mm",
            "speed": SWEEP_SPEED,
            "frame_rate": SWEEP_RATE,
            "exposure": f"{1e3 * config.calibration.stripe_exposure} ms",
        }
    )
    profiles: list[StripeProfile] = []
    plan = ScanPlan(view.base_from_flange, view.base_from_flange, *ends)
    errors = SweepErrors(np.zeros((6, 6)), config.calibration.rail_sigma, MAX_SHIFT, devices.clock.rate)
    collector = SweepCollector(geometry, section, keep_frame, progress, profiles.append)
    rehearse(geometry)
    swath = rail_sweep(plan, mover, devices, errors, collector)
    return [
        ScanObservation(None, profiles[line], swath.base_from_flange, float(position))
        for line, position in zip(swath.lines, swath.rail, strict=True)
    ]


def _found(camera: Camera, board: BoardSpec, name: str, keep: Keep, what: str) -> BoardView:
    refusals = Counter[str]()
    seen = look_for(camera, board, refusals, keep, what)
    if seen is None:
        raise RefusedError(
            f"the {name} board on the deck is not seen where the calibration has it: {next(iter(refusals))}; clean it, "
            "see that it and the camera are in place, then run `cell calibrate`"
        )
    return seen


def _beside(view: CalibrationView, turn: int) -> CalibrationView:
    """A pose near a view, up and to another side each time."""
    side = 2.4 * turn
    away = np.array([BACK_M * np.cos(side), BACK_M * np.sin(side), BACK_M])
    moved = pin.SE3(view.base_from_flange.rotation, view.base_from_flange.translation + away)
    return CalibrationView(moved, view.rail_position)
