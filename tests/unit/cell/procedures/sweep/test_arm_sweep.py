"""A sweep by the arm alone, on the devices in this process: its place is known as well as the arm's times are."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_parts, from_ur
from cell.motion.arm_models import HOME
from cell.procedures.arm.camera_poses import ScanPlan
from cell.procedures.arm.moves import Mover
from cell.procedures.sweep.arm_sweep import JITTER_S, LATENCY_S, arm_sweep
from cell.procedures.sweep.swath import Swath, SweepCollector, SweepErrors
from drivers.errors import DeviceFault
from drivers.interfaces import Frame
from sim_backends.direct.arm import DirectArm
from tests.unit.cell.procedures.sweep.test_rail_sweep import CONFIG, ERRORS, GEOMETRY, SCAN

LENGTH = 0.02


def nothing(arm: DirectArm) -> None:
    """Nobody meddles."""


def sweep(
    late: float = 0.0,
    meddle: Callable[[DirectArm], None] = nothing,
    made: VirtualCell | None = None,
    errors: SweepErrors = ERRORS,
) -> tuple[Swath, float]:
    """Sweep 20 mm at 20 mm/s, each state of the arm `late` s late; and how far off the lines truly lie, m.

    `meddle` is called with each of ten frames from the middle.
    """
    cell = made or VirtualCell(CONFIG, seed=4, level="ideal")
    devices, arm, camera = cell.devices, cell.arm, cell.scan_camera
    devices.vehicle.brake()
    devices.rail.home().wait(60.0)
    mover = Mover(devices.arm, cell.clock, CONFIG, None)
    mover.to_joints(HOME)
    start: pin.SE3 = from_ur(arm.state().flange)
    end = from_parts(np.array([0.0, LENGTH, 0.0])) * start
    arm.late = late
    taken: list[int] = []

    def keep(frame: Frame) -> None:
        taken.append(frame.frame_id)
        if 18 < len(taken) <= 28:
            meddle(arm)

    collector = SweepCollector(GEOMETRY, SCAN, keep, lambda fraction, text: None)
    swath = arm_sweep(ScanPlan(start, end, 0.03, 0.03), mover, devices, errors, collector)
    truth = np.array([camera.shots[int(k)].base_from_flange[:3, 3] for k in swath.frame_ids])
    return swath, float(np.abs(swath.flanges[:, :3, 3] - truth).max())


def test_a_sweep_that_nothing_disturbed_lies_where_it_says() -> None:
    swath, off = sweep()
    assert len(swath.lines) == pytest.approx(20, abs=2)
    assert off < 10e-6
    assert off < swath.shift < 25e-6


def test_the_laser_goes_off_before_a_camera_that_is_slow_to_end_its_stream() -> None:
    cell = VirtualCell(CONFIG, seed=4, level="ideal")
    cell.scan_camera.lingers = 2.0
    swath, _ = sweep(made=cell)
    assert cell.world.laser.at(swath.times[-1])
    assert not cell.world.laser.at(cell.clock.now() - 1.9)


def test_an_arm_that_is_pushed_again_and_again_is_a_fault() -> None:
    def push(arm: DirectArm) -> None:
        arm.model.drive.q[0] += 0.001

    with pytest.raises(DeviceFault, match="did not move evenly") as caught:
        sweep(meddle=push)
    assert caught.value.code == "arm.uneven_sweep"


@pytest.mark.parametrize("late", [0.02, 0.2])
def test_states_that_are_all_late_are_refused_with_what_they_leave_open(late: float) -> None:
    with pytest.raises(DeviceFault) as caught:
        sweep(late)
    assert caught.value.code == "arm.late_readings"
    assert caught.value.recoverable
    told = re.search(r"those of the arm to ±([\d.]+) ms", str(caught.value))
    assert told is not None
    assert float(told[1]) == pytest.approx(0.5e3 * late, abs=0.6)
    assert "allowed are 0.150 mm" in str(caught.value)


@pytest.mark.parametrize("rate", [1.0, 3.0])
def test_lateness_that_is_allowed_is_in_the_budget(rate: float) -> None:
    late = 0.01
    swath, off = sweep(late, errors=replace(ERRORS, rate=rate))
    # The trap: the states lie on a perfect line, and the sweep is half of the lateness off.
    assert swath.residual < 10e-6
    # From tick to tick the simulated arm's speed differs by a tenth from that of the sweep.
    assert off == pytest.approx(0.5 * late * SCAN.speed, rel=0.15)
    assert off <= swath.shift < 0.15e-3
    stated = np.sqrt(np.trace(swath.covariance[:3, :3]))
    assert stated == pytest.approx(np.hypot(swath.shift / np.sqrt(3), rate * LATENCY_S * SCAN.speed), rel=0.1)
    np.testing.assert_allclose(np.linalg.norm(swath.line_spread, axis=1), rate * JITTER_S * SCAN.speed)
