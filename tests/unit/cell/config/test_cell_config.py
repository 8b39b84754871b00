"""Configuration and jobs: every quantity has its unit, every value its range, every mistake its own clear line.

Boxes that a configuration or a job names are kept away from: by planned ways, by raw commands, by the vehicle."""

import tomllib
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cell.config.cell_config import CellConfig, StationObstacle, default_toml, load_config, validate
from cell.config.job import Job, load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_parts, from_ur
from cell.measure.inversion import NominalSurface
from cell.measure.vision.board.view import parse_board
from cell.motion.collision import CollisionError
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import Mover
from cell.procedures.drive.driving import Planar
from cell.procedures.drive.way import Upright, Way, Whereabouts
from drivers.errors import ConfigError, InterlockError, RefusedError
from sim_backends.models.arm_kinematics import UR10E_DH, Kinematics

JOB, MESH = load_job("pot")
forward = Kinematics(UR10E_DH).forward
"""The simulated arm's own kinematics, which is not the planner's."""
POST = """
[[obstacle]]
name = "post"
base_from_centre = { translation = ["%d mm", "%d mm", "300 mm"], rotation = ["0 deg", "0 deg", "0 deg"] }
size = ["60 mm", "60 mm", "700 mm"]"""
CLAW = ((-0.03, 0.03), (-0.03, 0.03), (0.0, 0.145))
SCAN_HEAD = ((0.065, 0.115), (-0.11, 0.08), (0.02, 0.09))
TARGET_CAMERA = ((-0.125, -0.075), (-0.025, 0.025), (-0.03, 0.05))
TIPS = np.array([corner for box in (CLAW, SCAN_HEAD, TARGET_CAMERA) for corner in product(*box)])
"""Their corners (24, 3) in the flange frame, m."""


def configured(folder: Path, text: str) -> CellConfig:
    path = folder / "cell.toml"
    path.write_text(default_toml() + text)
    return load_config(path)


def mover_of(config: CellConfig, job: Job | None = JOB) -> tuple[VirtualCell, Mover]:
    cell = VirtualCell(config, seed=1, level="ideal")
    cell.devices.vehicle.brake()
    return cell, Mover(cell.devices.arm, cell.clock, config, job, interlocks=cell.devices.interlocks)


def test_the_arm_goes_round_a_post_on_the_vehicle_and_a_raw_move_into_it_is_refused(tmp_path):
    _, free = mover_of(load_config(None), None)
    free.to_joints(HOME)
    turned = HOME + np.array([1.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    straight = free.plan_to(pin.SE3(forward(turned)), "beside")
    middle = forward(straight.joints[len(straight.joints) // 2])[:3, 3]
    config = configured(tmp_path, POST % tuple(1e3 * middle[:2]))
    cell, mover = mover_of(config, None)
    mover.to_joints(HOME)
    around = mover.plan_to(pin.SE3(forward(turned)), "beside")
    for flange in map(forward, around.joints):
        tips = TIPS @ flange[:3, :3].T + flange[:3, 3]
        assert not ((np.abs(tips[:, :2] - middle[:2]) < 0.03).all(axis=1) & (tips[:, 2] < 0.65)).any()
    assert around.duration > straight.duration
    with pytest.raises(InterlockError, match="obstacle post would collide on the way"):
        cell.devices.arm.move_joints(turned, 0.3, 1.0)


def test_an_obstacle_is_read_with_units_and_one_name_each(tmp_path):
    assert configured(tmp_path, POST % (0, 600)).obstacle[0].size == pytest.approx((0.06, 0.06, 0.7))
    assert configured(tmp_path, POST % (0, 600)).calibration_hash() == load_config(None).calibration_hash()
    with pytest.raises(ConfigError, match="obstacle post is there twice"):
        configured(tmp_path, POST % (0, 600) + POST % (0, 700))
    with pytest.raises(ConfigError, match="size"):
        configured(tmp_path, (POST % (0, 600)).replace('"700 mm"', "700"))


def beside_the_target(solid: Upright, gap: float) -> Job:
    """The job with a beam `gap` m ahead of where `solid` (in the vehicle's frame) is at the target, at its height."""
    target = JOB.approach.target.se3()
    ahead = Planar.of(target).x + solid.corners[:, 0].max() + gap
    middle = (ahead + 0.05, Planar.of(target).y + solid.corners[:, 1].mean(), 0.5 * (solid.low + solid.high))
    centre = {"translation": [f"{1e3 * v:.3f} mm" for v in middle], "rotation": ["0 deg"] * 3}
    beam = StationObstacle.model_validate(
        {"name": "beam", "size": ["100 mm", "50 mm", "20 mm"], "place_from_centre": centre}
    )
    return JOB.model_copy(update={"obstacle": (beam,)})


def test_the_vehicle_keeps_the_arm_that_it_carries_off_the_station(tmp_path):
    config = load_config(None)
    cell, mover = mover_of(config)
    mover.to_joints(HOME)
    stand = config.arm.vehicle_from_base.se3()
    lifted = from_parts((0.0, 0.0, JOB.approach.target.se3().translation[2]))
    solids = [Upright.of(body, lifted * stand) for body in mover.solids()]
    front = max((s for s in solids if s.name not in ("deck", "part")), key=lambda solid: solid.corners[:, 0].max())
    whereabouts = Whereabouts(cell.vehicle)
    whereabouts.enter(JOB)
    whereabouts.see(Planar.of(JOB.approach.staging.se3()))
    target = Planar.of(JOB.approach.target.se3())
    Way(beside_the_target(front, 0.3), stand, whereabouts, mover.solids()).require_line(target)
    way = Way(beside_the_target(front, 0.02), stand, whereabouts, mover.solids())
    with pytest.raises(RefusedError, match=r"with the arm's [\w ]+ within \d+ mm of the station obstacle beam"):
        way.require_line(target)


def test_a_jobs_obstacle_is_met_by_no_planned_way(tmp_path):
    config = load_config(None)
    cell, mover = mover_of(config)
    mover.to_joints(HOME)
    flange = from_ur(cell.devices.arm.state().flange)
    beam = beside_the_target(Upright("x", np.zeros((4, 2)), 0.0, 0.0), 0.0).obstacle[0]
    goal = from_parts((0.0, 0.0, -0.1)) * flange
    at = goal.translation + np.array([0.0, 0.0, -0.16])
    extent = NominalSurface.load(MESH, unit=JOB.surface.mesh_unit).extent
    far = from_parts((0.0, 3.0, -1.0))
    centre = beam.place_from_centre.model_copy(update={"translation": tuple(far.inverse().act(at).tolist())})
    here = beam.model_copy(update={"place_from_centre": centre})
    mover.avoid_station(far, JOB.model_copy(update={"obstacle": (here,)}), parse_board(JOB.board.spec), extent)
    with pytest.raises(CollisionError, match="station obstacle beam"):
        mover.plan_to(goal, "down")


def test_a_raw_joint_move_takes_no_corner_of_the_tool_faster_than_allowed():
    config = load_config(None)
    cell, mover = mover_of(config, None)
    mover.to_joints(HOME)
    goal = HOME + np.array([0.9, 0.0, 0.0, 0.0, 0.0, 0.0])
    began = cell.clock.now()
    motion = cell.devices.arm.move_joints(goal, config.arm.max_joint_speed, 3.0)
    places = []
    while not motion.done:
        flange = forward(cell.devices.arm.state().joints)
        places.append((cell.clock.now(), TIPS @ flange[:3, :3].T + flange[:3, 3]))
        cell.clock.sleep(0.01)
    motion.wait(1.0)
    assert cell.clock.now() - began > 1.0
    fastest = max(
        np.linalg.norm(b - a, axis=1).max() / (later - now)
        for (now, a), (later, b) in zip(places[:-4], places[4:], strict=True)
        if later > now
    )
    assert 0.4 < fastest <= 1.01 * config.arm.max_tool_speed
    assert np.allclose(cell.devices.arm.state().joints, goal, atol=1e-3)


def edited(**changes: Any) -> dict[str, Any]:
    """The shipped configuration with "table__key" set to another value."""
    data = tomllib.loads(default_toml())
    for path, value in changes.items():
        table, key = path.split("__")
        data[table][key] = value
    return data


@pytest.mark.parametrize("lead", ["50.1 mm", "0.09 mm"])
def test_a_wrong_configuration_is_refused_by_key_and_value(lead: str):
    """Wrong values of all other keys: `integration/virtual/test_wrong_inputs.py`."""
    with pytest.raises(ConfigError, match=r"rail\.lead: .*0\.1 to 50 mm"):
        validate(CellConfig, edited(rail__lead=lead), "cell.toml")


def test_addresses_do_not_make_a_calibration_foreign_but_optics_do():
    own = load_config(None).calibration_hash()
    moved = validate(CellConfig, edited(scan_camera__address="10.0.0.1:1", rail__url="/dev/ttyUSB9"), "cell.toml")
    other = validate(CellConfig, edited(scan_camera__focal_length="8.1 mm"), "cell.toml")
    assert moved.calibration_hash() == own
    assert other.calibration_hash() != own
    band = {"centre": "660 nm", "width": "20 nm", "transmission": 0.9}
    filtered = validate(CellConfig, edited(scan_camera__filter=band), "cell.toml")
    assert filtered.calibration_hash() != own and filtered.scan_camera.filter.width == pytest.approx(20e-9)
