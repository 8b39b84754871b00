"""The arm's moves: at a person's pace, with the same joints wherever it comes from, and to where it rests."""

import numpy as np
import pytest

from cell import Cell
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_parts, from_ur
from cell.motion.collision import CollisionError
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import LEAST, Mover, Pace, nested_parts, placed_parts
from cell.procedures.arm.photograph import drawn_interim_view
from cell.procedures.calibrate.interim import resting_pose
from drivers.errors import ConfigError
from tests.unit.cell.procedures.drive.test_way import JOB, Site

CONFIG = load_config(None)


def test_the_arm_goes_the_same_way_at_a_share_of_its_speed_from_the_next_motion_on():
    cell, pace = VirtualCell(CONFIG, 2, "nominal"), Pace()
    cell.devices.vehicle.brake()
    mover = Mover(cell.devices.arm, cell.clock, CONFIG, None, interlocks=cell.devices.interlocks, pace=pace)
    mover.to_joints(HOME)
    there = HOME + np.array([0.3, 0.1, 0.0, 0.0, 0.0, 0.0])

    def speeds(move) -> tuple[float, float]:
        """Of the leading joint, largest, and of the flange, largest."""
        with cell.devices.arm.record() as states:
            move()
        places = np.array([state.flange[:3] for state in states])
        times = np.array([state.device_time for state in states])
        flange = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(times)
        return max(float(np.abs(state.joint_speeds).max()) for state in states), float(flange.max())

    def line() -> None:
        below = from_parts((0.0, 0.0, 0.05)) * from_ur(cell.devices.arm.state().flange)
        mover.line(below, 0.1)

    whole, straight = speeds(lambda: mover.to_joints(there))[0], speeds(line)[1]
    pace.share = 0.5
    assert speeds(lambda: mover.to_joints(HOME))[0] == pytest.approx(0.5 * whole, rel=0.08)
    assert np.abs(cell.devices.arm.state().joints - HOME).max() < 1e-3
    assert speeds(line)[1] == pytest.approx(0.5 * straight, rel=0.05)


WIDE = (0.6, 0.6, 0.02)


def mover_with(size: tuple[float, float, float] | None) -> Mover:
    """In a cell of its own, with a part of this size in the claw."""
    cell = VirtualCell(CONFIG, 2, "nominal")
    cell.devices.vehicle.brake()
    job = None if size is None else JOB.model_copy(update={"grasp": JOB.grasp.model_copy(update={"size": size})})
    return Mover(cell.devices.arm, cell.clock, CONFIG, job, interlocks=cell.devices.interlocks)


@pytest.mark.parametrize("size", [None, WIDE])
def test_the_gate_knows_the_part_that_a_job_has_in_the_claw(size: tuple[float, float, float] | None):
    known = mover_with(size)._interlocks.situation.part
    assert [body.size for body in known] == ([] if size is None else [size])


def test_wherever_the_arm_stands_it_comes_to_a_pose_with_the_same_joints():
    """But for whole turns, of which it makes the fewest: the last joint's is spared from one turn further on."""
    mover = mover_with(None)
    pose = drawn_interim_view(CONFIG).base_from_flange
    expected = mover.kinematics.ik(pose, HOME)

    def off() -> np.ndarray:
        """From these joints, but for whole turns."""
        return np.abs((mover.joints - expected + np.pi) % (2 * np.pi) - np.pi)

    mover.to(pose, "the view")
    assert off().max() > 0.5, "from where the world begins, other joints are nearer"
    mover.to_as_from(HOME, pose, "the view")
    assert off().max() < 1e-3
    turned = expected + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2 * np.pi])
    mover.to_joints(turned)
    mover.to_as_from(HOME, pose, "the view")
    assert mover.joints == pytest.approx(turned, abs=1e-3)


def test_between_jobs_the_arm_rests_where_the_next_looks_first_or_else_at_home():
    mover = mover_with(None)
    mover.fold()
    assert mover.joints == pytest.approx(HOME, abs=1e-3)
    rest = resting_pose(drawn_interim_view(CONFIG))
    for unreachable in (from_parts((3.0, 0.0, 0.0)), from_parts((0.0, 0.0, -0.5)) * rest):
        mover.rest_at(unreachable)
        mover.fold()
        assert mover.joints == pytest.approx(HOME, abs=1e-3)
    mover.rest_at(rest)
    mover.fold()
    assert np.linalg.norm(mover.kinematics.fk(mover.joints).actInv(rest).translation) < 1e-4


def test_with_a_part_that_has_no_room_there_the_arm_rests_at_home():
    view = drawn_interim_view(CONFIG).base_from_flange
    for mover, rests in ((mover_with((0.07, 0.036, 0.02)), True), (mover_with(WIDE), False)):
        mover.rest_at(view)
        # The claw is empty then, but the next part has as little room.
        mover.leave_part(from_parts((0.8, 0.0, 0.0)))
        mover.fold()
        assert (np.abs(mover.joints - HOME).max() > 0.5) == rests


def test_a_view_is_taken_with_the_calibrations_joints_or_not_at_all():
    view = drawn_interim_view(CONFIG).base_from_flange
    mover = mover_with(None)
    mover.to_view(view)
    assert mover.joints == pytest.approx(mover.kinematics.ik(view, HOME), abs=1e-3)
    with pytest.raises(CollisionError):
        mover_with(WIDE).to_view(view)


def test_the_vehicle_drives_at_a_share_of_the_jobs_speed():
    def fastest(share: float) -> float:
        site, pace, speeds = Site(), Pace(), [0.0]
        pace.share = share
        site.whereabouts.say_at_start()
        site.run(check=lambda: speeds.append(abs(site.vehicle.state().speed)), pace=pace)
        return max(speeds)

    for share in (1.0, 0.5):
        assert fastest(share) == pytest.approx(share * JOB.approach.speed, rel=0.1)


@pytest.mark.parametrize("share", [0.0, 0.9 * LEAST, 1.01, float("nan"), True, "fast", None])
def test_what_is_no_pace_is_refused_with_what_is_allowed(share: object):
    pace = Pace()
    with pytest.raises(ConfigError, match=r"allowed are 0\.25 to 1"):
        pace.share = share
    assert pace.share == 1.0


def test_a_cell_is_slowed_from_outside_while_it_works():
    with Cell.open(sim="all", clock="virtual", seed=4) as cell:
        assert cell.pace == 1.0
        cell.pace = 0.3
        assert cell.mover(None).pace.share == 0.3
        with pytest.raises(ConfigError):
            cell.pace = 2.0


def test_parts_of_other_items_are_kept_clear_of_but_in_the_items_own_place():
    tray, new = load_job("tray4#2")[0], load_job("swap#2")[0]
    place = from_parts((1.0, 0.0, 0.6))
    nested, placed = nested_parts(tray), placed_parts(tray, place)
    assert [body.name for body in nested] == [f"part in the nest of item {k}" for k in (1, 3, 4)]
    assert [body.name for body in placed] == [f"part in the place of item {k}" for k in (1, 3, 4)]
    middle = np.array([0.0, 0.0, 0.5 * tray.grasp.size[2]])
    np.testing.assert_allclose(nested[0].placement.translation, np.add(middle, (-0.6, 0.1, 0.03)), atol=1e-12)
    np.testing.assert_allclose(placed[0].placement.translation, np.add(middle, (0.95, -0.06, 0.6)), atol=1e-12)
    assert placed_parts(new, place) == [] and len(nested_parts(new)) == 1
    cell = VirtualCell(CONFIG, 2, "nominal")
    mover = Mover(cell.devices.arm, cell.clock, CONFIG, tray)
    assert {body.name for body in nested} <= {body.name for body in mover.solids()}
