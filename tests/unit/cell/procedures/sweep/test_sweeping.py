"""A sweep that something disturbed is a fault that names it, on the devices without wires: nothing of it is used.

By the rail, and by the arm alone: then its place is known as well as the arm's times are."""

import dataclasses
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import load_config
from cell.config.job import ScanSection, load_job
from cell.devices.gate.gated import UNATTENDED_S
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import from_parts, from_ur
from cell.measure.reconstruction.build import ScanGeometry
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import Mover
from cell.procedures.arm.photograph import ScanPlan
from cell.procedures.sweep.swath import Swath, SweepCollector, SweepErrors
from cell.procedures.sweep.sweeping import JITTER_S, LATENCY_S, arm_sweep, beside_arm, home_rail, rail_sweep
from drivers.errors import DeviceFault, LimitError
from drivers.interfaces import Frame, Motion, Rail, RailState
from sim_backends.direct.arm import DirectArm

CONFIG = load_config(None)
SCAN = load_job("pot")[0].scan.model_copy(update={"length": 0.02, "speed": 0.02, "frame_rate": 20.0})
GEOMETRY = ScanGeometry(
    nominal_camera(CONFIG.scan_camera), LightPlane.of((1.0, 0.0, -1 / 3.5), -0.035), np.array([1.0, 0.0, 0.0]),
    CONFIG.scan_camera.flange_from_camera.se3(),
)  # fmt: skip
ERRORS = SweepErrors(np.zeros((6, 6)), 5e-6, 0.15e-3)
Meddle = Callable[[VirtualCell], None]


def nothing(of: object) -> None:
    """Nobody meddles."""


def ready(made: VirtualCell | None) -> tuple[VirtualCell, Mover, pin.SE3]:
    """A cell that may sweep, homed and folded; its arm's moves, and where the flange stands."""
    cell = made or VirtualCell(CONFIG, seed=4, level="ideal")
    cell.devices.vehicle.brake()
    cell.devices.interlocks.work_with(CONFIG.calibration_hash())
    cell.devices.rail.home().wait(60.0)
    mover = Mover(cell.devices.arm, cell.clock, CONFIG, None)
    mover.to_joints(HOME)
    return cell, mover, from_ur(cell.devices.arm.state().flange)


def sweep(
    meddle: Meddle = nothing, late: float = 0.0, camera_late: float = 0.0, errors: SweepErrors = ERRORS,
    made: VirtualCell | None = None, scan: ScanSection = SCAN,
) -> Swath:  # fmt: skip
    """Sweep 20 mm, at 20 mm/s if not told otherwise; half-way `meddle` is called once. Replies of rail and camera come
    so many s late."""
    cell, mover, pose = ready(made)
    cell.rail.late, cell.scan_camera.late = late, camera_late
    taken: list[int] = []

    def keep(frame: Frame, cut: object) -> None:
        taken.append(frame.frame_id)
        if len(taken) == 10:
            meddle(cell)

    collector = SweepCollector(GEOMETRY, scan, keep, lambda fraction, text: None)
    return rail_sweep(ScanPlan(pose, pose, 0.03, 0.05), mover, cell.devices, errors, collector)


def refused(code: str, meddle: Meddle = nothing, late: float = 0.0, camera_late: float = 0.0) -> str:
    with pytest.raises(DeviceFault) as caught:
        sweep(meddle, late, camera_late)
    assert caught.value.code == code
    return str(caught.value)


def push_the_arm(cell: VirtualCell) -> None:
    cell.arm.model.drive.q[0] += 0.0005


def drive_the_rail_slower(cell: VirtualCell) -> None:
    model, now = cell.world.rail, cell.clock.now()
    slower = dataclasses.replace(model.settings, max_velocity=round(0.9 * model.settings.max_velocity))
    model.configure(now, slower)


def set_the_clock(cell: VirtualCell, by: float = 0.010) -> None:
    model = cell.scan_camera.model
    model.spec = dataclasses.replace(model.spec, epoch=model.spec.epoch + by)


def lose(count: int) -> Meddle:
    def meddle(cell: VirtualCell) -> None:
        cell.scan_camera.model.fault("camera.frame_loss", count)

    return meddle


def test_a_sweep_that_nothing_disturbed_knows_its_place_to_micrometres_and_has_a_picture_of_its_middle():
    swath = sweep()
    assert len(swath.lines) == pytest.approx(20, abs=2)
    assert swath.lost == 0
    # Half a round trip of 0.5 ms of the camera's, at 20 mm/s, and next to nothing of the rail's many readings.
    assert 0.0 < swath.shift < 10e-6
    assert np.sqrt(np.linalg.eigvalsh(swath.covariance)[-1]) == pytest.approx(swath.shift / np.sqrt(3), rel=0.3)
    taken, frames = swath.seen.tolist(), SCAN.length / SCAN.speed * SCAN.frame_rate
    assert taken.index(swath.middle.frame_id) == pytest.approx(frames / 2, abs=1)
    assert len(taken) > 0.9 * frames


def test_a_sweep_that_lasts_longer_than_the_laser_may_burn_unattended_keeps_it_lit():
    slow = SCAN.model_copy(update={"speed": 0.0008, "frame_rate": 1.0})
    assert SCAN.length / slow.speed > UNATTENDED_S
    assert len(sweep(scan=slow).lines) == pytest.approx(25, abs=2)


class HomedEarlier:
    """A rail that another program has homed."""

    def __init__(self, bare: Rail) -> None:
        self.bare, self.searched = bare, False

    def __getattr__(self, name: str) -> object:
        return getattr(self.bare, name)

    def state(self) -> RailState:
        return dataclasses.replace(self.bare.state(), homed_here=self.searched)

    def home(self) -> Motion:
        self.searched = True
        return self.bare.home()


def test_a_zero_that_another_program_found_is_searched_again_before_a_sweep():
    cell = VirtualCell(CONFIG, seed=4, level="ideal")
    cell.rail.home().wait(60.0)
    rail = HomedEarlier(cell.rail)
    cell.devices.rail.bare = rail  # type: ignore[assignment]
    assert cell.devices.rail.state().homed
    home_rail(cell.devices)
    assert rail.searched


def test_a_rail_that_somebody_drives_slower_meanwhile_is_uneven():
    assert "off an even motion" in refused("rail.uneven_sweep", drive_the_rail_slower)


def test_a_camera_whose_clock_is_set_meanwhile_is_a_fault():
    told = refused("camera.clock_stepped", set_the_clock)
    (step,) = re.findall(r"stepped by about ([+-]\d+\.\d) ms", told)
    assert float(step) == pytest.approx(10.0, abs=4.0)
    assert len(sweep(lambda cell: set_the_clock(cell, 0.001)).lines) == pytest.approx(20, abs=2)


def test_an_arm_that_is_pushed_meanwhile_is_a_fault():
    assert "the flange moved by" in refused("arm.moved_in_sweep", push_the_arm)


def test_more_lost_frames_than_a_twentieth_are_a_fault():
    refused("camera.frames_lost", lose(2))
    assert sweep(lose(1)).lost == 1


@pytest.mark.parametrize("late", [0.02, 0.2])
def test_replies_that_are_all_late_are_refused_with_what_they_leave_open(late: float):
    said = refused("rail.late_readings", late=late)
    told = re.search(r"those of the rail to ±([\d.]+) ms", said)
    assert float(told[1]) == pytest.approx(0.5e3 * late, abs=0.25)
    assert "allowed are 0.150 mm" in said
    assert "sweep more slowly" in said


def test_lateness_that_is_allowed_is_in_the_budget():
    late = 0.01
    swath = sweep(late=late)
    # The trap: the readings show nothing of it, and the positions are off by half of it at 20 mm/s.
    assert swath.residual < 10e-6
    assert swath.shift == pytest.approx(0.5 * late * SCAN.speed, abs=15e-6)
    assert np.sqrt(np.trace(swath.covariance[:3, :3])) == pytest.approx(swath.shift / np.sqrt(3), rel=0.1)


def test_a_camera_whose_clock_cannot_be_compared_well_is_refused_as_well():
    assert re.search(r"those of the camera to ±100\.\d ms", refused("camera.late_readings", camera_late=0.2))


def swept_by_arm(
    late: float = 0.0,
    meddle: Callable[[DirectArm], None] = nothing,
    made: VirtualCell | None = None,
    errors: SweepErrors = ERRORS,
) -> tuple[Swath, float]:
    """Sweep 20 mm at 20 mm/s, each state of the arm `late` s late; and how far off the lines truly lie, m. `meddle` is
    called with each of ten frames from the middle."""
    cell, mover, start = ready(made)
    devices, arm, camera = cell.devices, cell.arm, cell.scan_camera
    end = from_parts(np.array([0.0, SCAN.length, 0.0])) * start
    arm.late = late
    taken: list[int] = []

    def keep(frame: Frame, cut: object) -> None:
        taken.append(frame.frame_id)
        if 18 < len(taken) <= 28:
            meddle(arm)

    collector = SweepCollector(GEOMETRY, SCAN, keep, lambda fraction, text: None)
    swath = arm_sweep(ScanPlan(start, end, 0.03, 0.03), mover, devices, errors, collector)
    truth = np.array([camera.shots[int(k)].base_from_flange[:3, 3] for k in swath.frame_ids])
    return swath, float(np.abs(swath.flanges[:, :3, 3] - truth).max())


def test_a_sweep_that_nothing_disturbed_lies_where_it_says():
    swath, off = swept_by_arm()
    assert len(swath.lines) == pytest.approx(20, abs=2)
    assert off < 10e-6
    assert off < swath.shift < 25e-6


@pytest.mark.parametrize("by_arm", [False, True])
def test_the_laser_goes_off_before_a_camera_that_is_slow_to_end_its_stream(by_arm: bool):
    cell = VirtualCell(CONFIG, seed=4, level="ideal")
    cell.scan_camera.lingers = 2.0
    swath = swept_by_arm(made=cell)[0] if by_arm else sweep(made=cell)
    assert cell.world.laser.at(swath.times[-1])
    assert not cell.world.laser.at(cell.clock.now() - 1.9)


def test_an_arm_that_is_pushed_again_and_again_is_a_fault():
    def push(arm: DirectArm) -> None:
        arm.model.drive.q[0] += 0.001

    with pytest.raises(DeviceFault, match="did not move evenly") as caught:
        swept_by_arm(meddle=push)
    assert caught.value.code == "arm.uneven_sweep"


@pytest.mark.parametrize("late", [0.02, 0.2])
def test_states_that_are_all_late_are_refused_with_what_they_leave_open(late: float):
    with pytest.raises(DeviceFault) as caught:
        swept_by_arm(late)
    assert caught.value.code == "arm.late_readings"
    assert caught.value.recoverable
    told = re.search(r"those of the arm to ±([\d.]+) ms", str(caught.value))
    assert float(told[1]) == pytest.approx(0.5e3 * late, abs=0.6)
    assert "allowed are 0.150 mm" in str(caught.value)


@pytest.mark.parametrize("rate", [1.0, 3.0])
def test_lateness_that_is_allowed_is_in_the_budget_by_the_arm(rate: float):
    late = 0.01
    swath, off = swept_by_arm(late, errors=replace(ERRORS, rate=rate))
    # The trap: the states lie on a perfect line, and the sweep is half of the lateness off.
    assert swath.residual < 10e-6
    # From tick to tick the simulated arm's speed differs by a tenth from that of the sweep.
    assert off == pytest.approx(0.5 * late * SCAN.speed, rel=0.15)
    assert off <= swath.shift < 0.15e-3
    stated = np.sqrt(np.trace(swath.covariance[:3, :3]))
    assert stated == pytest.approx(np.hypot(swath.shift / np.sqrt(3), rate * LATENCY_S * SCAN.speed), rel=0.1)
    np.testing.assert_allclose(np.linalg.norm(swath.line_spread, axis=1), rate * JITTER_S * SCAN.speed)


def test_a_run_is_held_before_rail_and_arm_move_together_and_not_meanwhile():
    """Whoever is told that it is held may reach in."""
    cell, mover, pose = ready(None)
    rail, told = cell.devices.rail, list[str]()
    mover.hold = hold = lambda: told.append("held")
    with beside_arm(mover, rail, lambda: told.append("rail") or rail.move_to(0.09)):
        mover.to(pose * from_parts((0.0, 0.0, -0.02)), "somewhat back")
    assert told == ["held", "rail"] and rail.state().position == pytest.approx(0.09, abs=1e-5)
    for begin, error in (lambda: rail.move_to(1.0), LimitError), (lambda: rail.move_to(0.01), ZeroDivisionError):
        with pytest.raises(error), beside_arm(mover, rail, begin):
            raise ZeroDivisionError
        assert mover.hold is hold
    assert not rail.state().moving and rail.state().position > 0.05, "stopped on its way"
