"""The cell without wires keeps the devices' promises, its time is the world's, and the whole job on it is as good as
its declared noise allows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.inversion import NominalSurface
from drivers.errors import Aborted, DeadlineError, DeviceFault, InterlockError
from drivers.interfaces import ArmSafety
from lab.bench.job.accuracy import LIMITS, figures, summed_up
from lab.bench.job.expected import mean_distance
from lab.bench.job.whole_job import JobRecord, run_whole_job
from sim_backends.clock import SteppedClock
from tests.support.report_runs import pot

CONFIG = load_config(None)
Run = dict[str, Any]


@pytest.fixture(scope="module")
def cell() -> VirtualCell:
    made = VirtualCell(CONFIG, seed=4, level="ideal")
    made.rail.home().wait(60.0)
    return made


def test_stepped_time_never_runs_back():
    clock = SteppedClock()
    clock.step_to(2.0)
    assert clock.now() == 2.0
    with pytest.raises(ValueError, match="backwards"):
        clock.step_to(1.0)


def test_waiting_lets_just_that_much_time_pass(cell):
    before = cell.clock.now()
    cell.clock.sleep(0.123)
    assert cell.clock.now() == pytest.approx(before + 0.123, abs=1e-12)
    assert cell.world.arm.time == pytest.approx(before + 0.123, abs=1e-12)


def test_a_rail_move_takes_the_time_of_its_trapezoid(cell):
    rail = cell.rail
    rail.move_to(0.010).wait(30.0)
    begun = cell.clock.now()
    rail.move_to(0.090).wait(30.0)
    speed, acceleration = CONFIG.rail.max_speed, CONFIG.rail.acceleration
    assert cell.clock.now() - begun == pytest.approx(0.080 / speed + speed / acceleration, abs=0.02)
    assert rail.state().position == pytest.approx(0.090, abs=1e-7)


def test_a_sweep_knows_where_the_rail_was_at_any_time_of_it(cell):
    rail = cell.rail
    with pytest.raises(InterlockError):
        rail.sweep(0.02, 0.03, 0.015)
    rail.move_to(rail.sweep_start(0.02, 0.03, 0.015)).wait(30.0)
    sweep = rail.sweep(0.02, 0.03, 0.015)
    sweep.wait(30.0)
    begin, end = sweep.window
    assert end - begin == pytest.approx(0.010 / 0.015, rel=1e-3)
    for time in np.linspace(begin, end, 7)[1:-1]:
        # Answers fall anywhere in half a millisecond: 15 mm/s make 7 µm of it, and the line averages them.
        assert sweep.position_at(time) == pytest.approx(cell.world.rail.carriage(time), abs=4e-6)


def test_the_vehicle_counts_the_way_that_it_drove(cell):
    vehicle = cell.vehicle
    vehicle.enable()
    before, there = vehicle.state(), cell.world.vehicle.planar(cell.clock.now())
    for _ in range(25):
        vehicle.drive(0.2, 0.0)
        cell.clock.sleep(0.04)
    vehicle.brake()
    after, here = vehicle.state(), cell.world.vehicle.planar(cell.clock.now())
    assert np.hypot(after.x - before.x, after.y - before.y) == pytest.approx(
        np.hypot(here[0] - there[0], here[1] - there[1]), abs=2e-3
    )
    assert after.braked
    assert after.speed == 0.0
    with pytest.raises(InterlockError):
        vehicle.drive(0.1, 0.0)


def test_a_stop_of_the_rail_ends_its_motion_and_lasts_until_it_stands(cell):
    rail = cell.rail
    rail.move_to(0.010).wait(30.0)
    motion = rail.move_to(0.090)
    cell.clock.sleep(0.5)
    rail.stop()
    assert cell.world.rail.velocity(cell.clock.now()) == 0
    with pytest.raises(Aborted, match="before its target"):
        motion.wait(30.0)
    assert rail.state().homed


def test_a_search_that_was_stopped_has_found_no_zero():
    rail = VirtualCell(CONFIG, seed=4, level="ideal").rail
    search = rail.home()
    rail.clock.sleep(0.2)
    rail.stop()
    with pytest.raises(Aborted):
        search.wait(30.0)
    assert not rail.state().homed
    with pytest.raises(InterlockError, match="is not homed"):
        rail.move_to(0.02)


def test_a_protective_stop_is_unlocked_on_a_persons_word_after_its_delay_with_the_laser_off():
    made = VirtualCell(CONFIG, seed=4, level="ideal")
    arm = made.arm
    motion = arm.move_joints(arm.state().joints + 0.5, 0.5, 1.0)
    made.clock.sleep(0.3)
    arm.set_digital_output(CONFIG.laser.output, True)
    made.fault("arm.protective_stop")
    with pytest.raises(DeviceFault, match="protective stop") as caught:
        motion.wait(30.0)
    assert (caught.value.code, caught.value.recoverable) == ("arm.protective_stop", True)
    with pytest.raises(DeviceFault, match="nobody has confirmed"):
        arm.recover()
    assert not made.world.laser.at(made.clock.now())
    begun = made.clock.now()
    arm.recover(confirmed=True)
    assert made.clock.now() - begun >= made.world.arm.params.unlock_delay
    assert arm.state().safety is ArmSafety.NORMAL
    made.fault("arm.emergency_stop")
    with pytest.raises(DeviceFault) as caught:
        arm.recover(confirmed=True)
    assert (caught.value.code, caught.value.recoverable) == ("arm.emergency_stop", False)


def test_a_silent_camera_is_a_deadline_and_a_lost_frame_is_counted():
    made = VirtualCell(CONFIG, seed=4, level="ideal")
    camera = made.scan_camera
    camera.configure(0.002, 50.0)
    with camera.stream() as frames:
        first = frames.next(1.0)
        made.fault("camera.frame_loss")
        second = frames.next(1.0)
        assert (second.frame_id - first.frame_id, second.lost_before, frames.lost) == (2, 1, 1)
        made.fault("camera.silent")
        begun = made.clock.now()
        with pytest.raises(DeadlineError):
            frames.next(1.0)
        assert made.clock.now() - begun == pytest.approx(1.0, abs=0.05)
    with pytest.raises(DeadlineError):
        camera.grab()


def test_the_mean_length_of_a_round_gaussian_error_is_the_closed_form():
    # Maxwell's distribution: 2 σ √(2/π).
    assert mean_distance(np.eye(3)[None] * 4e-10) == pytest.approx(2 * 2e-5 * np.sqrt(2 / np.pi), rel=0.03)


SWEEP_SPEED = 0.030
"""Twice as fast as shipped, m/s: half the lines are enough for a test."""


def whole_job(name: str, changes: dict[str, object], calibrated: JobRecord | None = None) -> tuple[JobRecord, Run]:
    job, mesh = load_job(name)
    job = job.model_copy(update={"scan": job.scan.model_copy(update={"speed": SWEEP_SPEED, **changes})})
    nominal = NominalSurface.load(mesh)
    record = run_whole_job(CONFIG, job, nominal, 2, "nominal", calibrated=calibrated)
    assert (record.outcome, record.reason) == ("placed", "")
    return record, summed_up([figures(record, CONFIG, job, nominal)], "nominal")


@pytest.fixture(scope="module")
def single(placed_pot) -> tuple[JobRecord, Run]:
    return placed_pot, summed_up([figures(placed_pot, CONFIG, *pot())], "nominal")


def require_near_what_is_expected(result: Run) -> None:
    """One run is one draw of the calibration: three times what is expected on average is out of reach of chance."""
    for key in ("sensor_scan_mm", "arm_base_mm", "placement_mm"):
        assert 0.0 < result[key]["mean"] < 3.0 * result[key]["bound"]
        assert result[key]["bound"] < LIMITS[key]["mean"]
    assert result["outcomes"]["placed_within_tolerance"] == 1
    assert result["tilt_mrad"]["max"] < LIMITS["tilt_mrad"]["max"]


def test_the_whole_job_at_nominal_is_as_good_as_its_declared_noise(single):
    _, result = single
    require_near_what_is_expected(result)
    assert result["sensor_scan_mm"]["aligned_mean"] < result["sensor_scan_mm"]["mean"]
    assert result["chi2_per_dof"]["calibration"] == pytest.approx(1.0, abs=0.05)
    assert set(result["assumed_noise"]) >= {"arm_repeatability", "arm_dh_length", "speckle_contrast"}


@pytest.mark.campaign
def test_two_sweeps_side_by_side_place_a_part_wider_than_one(single):
    record, result = whole_job("panel", {}, calibrated=single[0])
    require_near_what_is_expected(result)
    made, pose = record.results["reconstruct"], record.results["invert_pose"]
    assert len(made.cloud.each_sweep()) == 2
    (seam,) = made.seams
    assert abs(seam.mean) < 4 * seam.expected_mean
    assert seam.rms < 3 * seam.expected_rms
    # One sweep alone is 36 mm wide and covers 60 % of the panel.
    assert pose.coverage > 0.8
    # Strips that were fitted as they lie would leave 1 mrad: their heights differ by 35 µm over 26 mm.
    assert pose.sigma[3:].max() < 0.25e-3


@pytest.mark.campaign
def test_a_sweep_by_the_arm_alone_places_the_part(single):
    record, result = whole_job("pot", {"mode": "arm"}, calibrated=single[0])
    require_near_what_is_expected(result)
    (swath,) = record.results["laser_sweep"].swaths
    assert np.ptp(swath.rail) == 0.0
    way = np.linalg.norm(swath.flanges[-1, :3, 3] - swath.flanges[0, :3, 3])
    assert way == pytest.approx(0.064, abs=2 * SWEEP_SPEED / 30)


def test_runs_that_end_early_are_counted_with_their_reasons():
    refused = {"seed": 3, "level": "harsh", "outcome": "refused", "reason": "no board", "stage": "calibrate"}
    result = summed_up([refused], "harsh")
    assert result["outcomes"]["refused"] == 1
    assert result["outcomes"]["placed_outside_tolerance"] == 0
    assert result["outcomes"]["reasons"] == {"calibrate: no board": 1}
    assert result["placement_mm"]["mean"] is None
    assert "limits" not in result
