"""The cell's work on its own calibration: make one over the boards on the deck, or look how good the stored one is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cell.calibration.archive import Observations
from cell.calibration.collect.boards import collect_scan, collect_target
from cell.calibration.collect.timing import collect_timing
from cell.calibration.collect.witness import look_at_witness
from cell.calibration.store import CellCalibration, gathered, solve_observations
from cell.calibration.verify.verdict import Verification
from cell.calibration.verify.views import collect_verification
from cell.config import CellConfig
from cell.devices.devices import Devices
from cell.job import Job
from cell.motion.arm_models import kinematics_name
from cell.run.recorded_work import Hands
from cell.steps.moves import Mover

Progress = Callable[[float, str], None]


def serial_numbers(devices: Devices) -> dict[str, str]:
    """Of the devices that a calibration belongs to, by name; asked from the devices themselves."""
    return {
        "arm": devices.arm.identity().serial,
        "rail": devices.rail.identity().serial,
        "scan_camera": devices.scan_camera.identity().serial,
        "target_camera": devices.target_camera.identity().serial,
    }


def arm_table(config: CellConfig, devices: Devices) -> str:
    """What the kinematics is called that the arm's controller computes with, and the cell after it."""
    return kinematics_name(config.arm.model, devices.arm.link_table())


def calibrate(
    config: CellConfig, devices: Devices, mover: Mover, hands: Hands, tell: Progress
) -> tuple[Observations, CellCalibration]:
    """Move through the calibration poses and solve: what was seen, and the calibration from it."""
    # In command, so that a vehicle that somebody else moves or releases is noticed.
    devices.vehicle.recover()
    given = config, devices, mover, hands.check
    scan = collect_scan(*given, lambda f, t: tell(0.65 * f, t), hands.keep)
    witness = look_at_witness(config, devices, hands.keep)
    target = collect_target(*given, lambda f, t: tell(0.65 + 0.3 * f, t), hands.keep)
    tell(0.96, "solving")
    observations = gathered(scan, target, serial_numbers(devices), config, arm_table(config, devices), witness)
    return observations, solve_observations(observations).calibration


def verify(
    config: CellConfig,
    devices: Devices,
    mover: Mover,
    calibration: CellCalibration,
    job: Job,
    hands: Hands,
    tell: Progress,
) -> Verification:
    """Look at the deck boards again: how good `calibration` is today, and what place error of `job` that makes."""
    devices.interlocks.work_with(calibration.configuration)
    devices.vehicle.recover()
    seen = collect_verification(config, devices, mover, calibration, hands.check, tell, hands.keep)
    return Verification.of(calibration, job, seen)


def time_stamps(
    config: CellConfig, devices: Devices, mover: Mover, calibration: CellCalibration, hands: Hands, tell: Progress
) -> CellCalibration:
    """Sweep to and fro over the fine board: `calibration` with how late the scan camera's time stamps come."""
    devices.interlocks.work_with(calibration.configuration)
    devices.vehicle.recover()
    timing = collect_timing(config, devices, mover, calibration, hands.check, tell, hands.keep)
    return replace(calibration, scan=replace(calibration.scan, timing=timing))
