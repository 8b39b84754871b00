"""The simulated cell is the cell that is described: every value arrives in the world, or is refused at once.

What is expected comes from the files' own numbers and closed forms, not from the code that reads them.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cell import Cell
from cell.check.fit import require_fit
from cell.config.cell_config import load_config, mounted
from cell.config.job import load_job
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from cell.motion.collision import tool_bodies
from drivers.errors import ConfigError
from sim_backends.world import drawing as nominal
from sim_backends.world.bodies.surfaces import own_surface
from sim_backends.world.drawing import STOCK, Drawing, inverse
from sim_backends.world.world import World, truth
from tests.support.described_cells import Changes, Numbers, described, pose, saddle, write_saddle


def drawing(folder: Path, config: Changes | None = None, job: Changes | None = None) -> Drawing:
    cell, own = described(folder, config, job)
    return Described.of(own).drawing(load_config(cell))


def ideal(folder: Path, config: Changes | None = None, job: Changes | None = None) -> VirtualCell:
    """The described cell without any deviation."""
    cell, own = described(folder, config, job)
    return VirtualCell(load_config(cell), 1, "ideal", Described.of(own))


def about(axis: str, degrees: float) -> np.ndarray:
    return np.asarray(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())


def light_on(world: World, place: tuple[float, float, float]) -> np.ndarray:
    """The picture of the stripe alone that the scan camera takes looking straight down at `place`, from 130 mm."""
    looking = nominal.pose((*place[:2], place[2] + 0.130), (1, 0, 0), (0, 0, -1))
    far = nominal.pose((-2.0, 0.0, 0.55), (1, 0, 0), (0, 0, 1))
    lit, dark = (
        world._cameras.picture("scan", looking, far, laser=on, exposure=0.002).astype(float) for on in (True, False)
    )
    light: np.ndarray = lit - dark
    light[light < 4] = 0.0
    return light


def true(cell: VirtualCell, name: str) -> np.ndarray:
    return np.array(cell.truth()["poses"][name])


# --- the stock cell ---


@pytest.mark.parametrize("job", ["pot", "seat", "panel"])
def test_what_ships_describes_the_stock_cell_to_the_last_bit(job: str):
    drawn = Described.of(job).drawing(load_config(None))
    size = (0.070, 0.060 if job == "panel" else 0.036, 0.020)
    stock = STOCK.with_surface(job)
    assert drawn.cell.scan.mounting is STOCK.cell.scan.mounting
    assert drawn.as_json() == stock.as_json().replace("[0.07, 0.036, 0.02]", str(list(size)))


def test_a_copy_of_a_shipped_mesh_is_known_by_what_is_in_it_not_by_its_name(tmp_path):
    own = {"surface": {"mesh": '"mine.ply"'}}
    described(tmp_path, None, own)
    pot = load_job("pot")[1]
    (tmp_path / "mine.ply").write_bytes(pot.read_bytes())
    assert drawing(tmp_path, None, own).station.surface == "pot"
    cell, job = described(tmp_path / "other", None, {"surface": {"mesh_unit": '"mm"'}})
    write_saddle(job.parent / "pot.ply")
    drawn = Described.of(job).drawing(load_config(cell))
    assert drawn.station.mesh == str(job.parent / "pot.ply")
    middle = np.zeros(1)
    assert World(1, "ideal", drawing=drawn).station.ground.height(middle, middle) == pytest.approx(
        saddle(0.0, 0.0), abs=1e-5
    )


# --- every value arrives ---


def test_the_carriage_goes_as_far_as_lead_steps_and_microsteps_say(tmp_path):
    rail = {"lead": '"5 mm"', "steps_per_turn": "400", "microsteps": "64", "travel": '["0 mm", "160 mm"]'}
    cell = ideal(tmp_path, {"rail": rail})
    cell.rail.home().wait(60.0)
    cell.rail.move_to(0.150).wait(60.0)
    now = cell.clock.now()
    assert cell.world.rail.position(now) == round(0.150 / 0.005 * 400 * 64)
    assert cell.world.rail.carriage(now) == pytest.approx(0.150, abs=1e-6)
    assert not cell.rail.state().right_switch


def test_cameras_hang_where_the_configuration_mounts_them(tmp_path):
    scan, target = ((60.0, 70.0, 80.0), (3.0, -4.0, 20.0)), ((0.0, -100.0, 30.0), (0.0, 0.0, 180.0))
    config = {
        "scan_camera": {"flange_from_camera": pose(*scan)},
        "target_camera": {"flange_from_camera": pose(*target)},
    }
    cell = ideal(tmp_path, config)
    for name, (translation, (x, y, z)) in (("scan", scan), ("target", target)):
        found = true(cell, f"flange_from_{name}_camera")
        assert found[:3, 3] == pytest.approx(1e-3 * np.array(translation))
        assert found[:3, :3] == pytest.approx(about("z", z) @ about("y", y) @ about("x", x))


def test_lens_sensor_and_light_plane_are_those_of_the_configuration(tmp_path):
    camera = {"focal_length": '"12 mm"', "pixel": '"3.45 um"', "width": "1024", "height": "768"}
    cell = ideal(tmp_path, {"scan_camera": camera, "laser": {"baseline": '"45 mm"', "tan_theta": "2.8"}})
    told = cell.truth()
    assert told["scan_lens"]["fx"] == pytest.approx(0.012 / 3.45e-6)
    assert (told["scan_lens"]["cx"], told["scan_lens"]["cy"]) == (511.5, 383.5)
    # X = −l + Z cot θ: it meets the optical axis l tan θ away.
    normal, distance = np.array(told["light_plane"]["normal"]), told["light_plane"]["distance"]
    assert distance / normal[2] == pytest.approx(0.045 * 2.8)
    assert distance / normal[0] == pytest.approx(-0.045)
    picture = cell.world.render("scan", 0.0, 0.002)
    assert picture.shape == (768, 1024)


def test_a_described_filter_takes_its_share_of_the_laser_and_most_of_the_room(tmp_path):
    band = {"filter": '{ centre = "660 nm", width = "20 nm", transmission = 0.5 }'}
    plain, filtered = ideal(tmp_path), ideal(tmp_path, {"scan_camera": band})
    assert filtered.world.scene.drawing.cell.scan.filter == pytest.approx((660e-9, 20e-9, 0.5))
    of_line = [np.percentile(light_on(cell.world, (0.0, 0.0, 0.6)), 99.9) for cell in (plain, filtered)]
    assert of_line[1] == pytest.approx(0.5 * of_line[0], rel=0.1)
    dark = [cell.world.render("scan", 0.0, 0.02).mean() for cell in (plain, filtered)]
    assert dark[1] < 0.2 * dark[0]


def test_station_vehicle_and_arm_stand_where_job_and_configuration_put_them(tmp_path):
    job = {
        "approach": {
            name: pose((x, 40.0, -500.0), (0.0, 0.0, 2.0))
            for name, x in (("start", -2900.0), ("staging", -1850.0), ("target", -1050.0))
        },
        "board": {
            "place_from_board": pose((200.0, 380.0, 200.0), (-135.0, 0.0, -90.0)),
            "spec": '"chessboard:8x5:18mm"',
        },
        "surface": {"place_from_surface": pose((20.0, -30.0, 12.0), (0.0, 0.0, 25.0))},
    }
    config = {"arm": {"model": '"UR5e"', "vehicle_from_base": pose((250.0, 50.0, 600.0), (0.0, 0.0, 10.0))}}
    cell = ideal(tmp_path, config, job)
    assert true(cell, "world_from_vehicle")[:3, 3] == pytest.approx([-2.9, 0.04, 0.0])
    assert true(cell, "world_from_vehicle")[:3, :3] == pytest.approx(about("z", 2.0))
    assert true(cell, "world_from_surface")[:3, 3] == pytest.approx([0.02, -0.03, 0.512])
    assert true(cell, "world_from_surface")[:3, :3] == pytest.approx(about("z", 25.0))
    assert true(cell, "world_from_board")[:3, 3] == pytest.approx([0.2, 0.38, 0.7])
    on_vehicle = inverse(true(cell, "world_from_vehicle")) @ true(cell, "world_from_base")
    assert on_vehicle[:3, 3] == pytest.approx([0.25, 0.05, 0.6])
    # Stretched out along −x: a2 + a3 of the maker's table (docs/reference/protocols.md, section 1).
    reach = cell.world.arm.kinematics.forward(np.zeros(6))[:3, 3]
    assert reach[0] == pytest.approx(-0.425 - 0.3922)


def test_outputs_are_those_that_the_configuration_wires(tmp_path):
    config = {"laser": {"output": "5"}, "claw": {"output": "4", "feedback": "3"}}
    cell = ideal(tmp_path, config)
    assert cell.devices.claw.holding
    cell.arm.set_digital_output(5, True)
    cell.clock.sleep(0.1)
    assert cell.truth()["laser_on"]
    cell.arm.set_digital_output(4, False)
    cell.clock.sleep(0.1)
    assert not cell.truth()["part"]["held"]


def test_deviations_are_drawn_about_what_is_described(tmp_path):
    """The same seed deviates by as much, whatever it deviates from."""
    drawn = drawing(tmp_path, {"rail": {"lead": '"5 mm"'}, "laser": {"baseline": '"45 mm"'}})
    stock, own = World(7, "nominal"), World(7, "nominal", drawing=drawn)
    assert own.scene.rail_lead_error == stock.scene.rail_lead_error
    shift = own.scene.laser_origin - stock.scene.laser_origin
    assert shift == pytest.approx([-0.010, 0.0, 0.0])


# --- a surface of one's own ---


def test_the_ground_under_an_own_mesh_is_its_closed_form(tmp_path):
    write_saddle(tmp_path / "saddle.ply")
    ground = own_surface(str(tmp_path / "saddle.ply"), "mm").ground
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-0.029, 0.029, 2000), rng.uniform(-0.0145, 0.0145, 2000)
    heights, normals = ground.sample(x, y)
    # Facets of half a millimetre on curvatures of up to 100 / m: 100 · .0005² / 8 = 3 µm, and the same once more.
    assert np.abs(heights - saddle(x, y)).max() < 8e-6
    step = 1e-5
    slope = (saddle(x + step, y) - saddle(x - step, y)) / (2 * step)
    assert np.abs(-normals[:, 0] / normals[:, 2] - slope).max() < 0.06
    beside = ground.height(np.array([0.031, -0.029]), np.array([0.0, 0.016]))
    assert (beside == 0.0).all()


def test_a_closed_solid_that_lies_beside_its_origin_is_felt_from_above(tmp_path):
    block = trimesh.creation.box((0.04, 0.03, 0.012))
    block.apply_translation([0.015, 0.004, 0.006])
    block.export(tmp_path / "block.stl")
    ground = own_surface(str(tmp_path / "block.stl"), "m").ground
    assert ground.height(np.array([0.0, 0.034, -0.006]), np.array([0.0, 0.018, 0.0])) == pytest.approx(
        [0.012, 0.012, 0]
    )


@pytest.mark.parametrize("lean", [(0.0, 0.0, 0.0), (0.0, 3.0, 25.0)])
def test_a_part_set_down_on_an_own_surface_rests_where_it_belongs(tmp_path, lean: Numbers):
    write_saddle(tmp_path / "saddle.ply")
    job = {
        "surface": {
            "mesh": '"saddle.ply"', "mesh_unit": '"mm"', "place_from_surface": pose((10.0, -20.0, 4.0), lean),
        },
        "grasp": {"size": '["60 mm", "30 mm", "20 mm"]'},
        "place": {"surface_from_part": pose((0.0, 0.0, 0.0), (0.0, 0.0, 30.0))},
    }  # fmt: skip
    world = World(1, "ideal", drawing=drawing(tmp_path, None, job))
    surface_from_part = world.scene.drawing.station.surface_from_part
    placed = world.scene.world_from_surface @ surface_from_part
    lifted = np.eye(4)
    lifted[2, 3] = 0.002
    world.part.set_claw(False, lifted @ placed @ inverse(world.scene.flange_from_part))
    rest = inverse(placed) @ world.part.part_pose(np.eye(4))
    # It falls straight down: on a surface that leans, that is a little sideways on it, and a point of it touches first.
    assert np.abs(rest[:3, 3]).max() < (2e-5 if lean == (0.0, 0.0, 0.0) else 2e-4)


def test_the_camera_sees_an_own_surface_where_it_stands(tmp_path):
    write_saddle(tmp_path / "saddle.ply")
    own = {"surface": {"mesh": '"saddle.ply"', "mesh_unit": '"mm"'}, "grasp": {"size": '["60 mm", "30 mm", "20 mm"]'}}
    world = World(1, "ideal", drawing=drawing(tmp_path, None, own))
    light = light_on(world, (0.0, 0.0, 0.60))
    rows = np.arange(200, 281, 10)
    u = (light * np.arange(640)).sum(axis=1)[rows] / light.sum(axis=1)[rows]
    per_px = 4.8e-6 / 0.008
    x, y = (u - 319.5) * per_px, (rows - 239.5) * per_px
    depth = 0.035 / (1 / 3.5 - x)
    assert 0.130 - depth == pytest.approx(saddle(x * depth, -y * depth), abs=6e-5)


# --- one world, one job after another ---


def test_the_claw_is_filled_again_and_the_station_set_up_for_the_next_job(tmp_path):
    cell = ideal(tmp_path)
    first = Described.of(tmp_path / "own.toml")
    stood = true(cell, "world_from_vehicle")
    cell.make_ready(first)
    assert cell.world.parts == 0, "nothing is done where the part is in the claw already"
    cell.arm.set_digital_output(1, False)
    cell.clock.sleep(0.1)
    assert not cell.devices.claw.holding
    cell.make_ready(first)
    cell.clock.sleep(0.1)
    assert cell.devices.claw.holding
    (tmp_path / "next").mkdir()
    write_saddle(tmp_path / "next" / "saddle.ply")
    _, job = described(
        tmp_path / "next",
        None,
        {
            "surface": {"mesh": '"saddle.ply"', "mesh_unit": '"mm"'},
            "board": {"place_from_board": pose((200.0, 380.0, 200.0), (-135.0, 0.0, -90.0))},
        },
    )
    cell.make_ready(Described.of(job))
    cell.clock.sleep(0.1)
    assert cell.devices.claw.holding
    assert cell.truth()["surface"]["name"] == "saddle"
    assert true(cell, "world_from_board")[:3, 3] == pytest.approx([0.2, 0.38, 0.8])
    assert true(cell, "world_from_vehicle") == pytest.approx(stood)


def test_each_part_lies_a_little_otherwise_in_the_claw_and_the_station_stays(tmp_path):
    world = World(5, "nominal")
    before = truth(world)["poses"]
    world.arm.write_digital_outputs(2, 0)
    world.part.set_claw(False, np.eye(4))
    world.make_ready(STOCK.station)
    after = truth(world)["poses"]
    assert before["flange_from_part"] != after["flange_from_part"]
    for name in ("world_from_surface", "world_from_board", "flange_from_scan_camera", "base_from_fine_board"):
        assert before[name] == after[name]


# --- what is not simulated as described ---

REFUSED: list[tuple[str, Changes, Changes, tuple[str, ...]]] = [
    ("a board that the world cannot print", {}, {"board": {"spec": '"charuco:9x7:20mm"'}},
     ("board.spec", "charuco:9x7:20mm", "marked_dots, asymmetric_dots, dots, chessboard", "name one of these")),
    ("a rate", {}, {"scan": {"frame_rate": '"200 Hz"', "speed": '"60 mm/s"'}},
     ("scan.frame_rate 200 Hz", "at most 120 Hz", "lower it")),
    ("a lens that blurs", {"scan_camera": {"focal_length": '"35 mm"', "width": "4096", "height": "3072"}}, {},
     ("calibration.fine.board", "35 mm", "allowed: at most", "take a board with a larger pitch")),
    ("a surface beside the table", {}, {"surface": {"place_from_surface": pose((240.0, 0.0, 0.0), (0.0, 0.0, 0.0))}},
     ("surface.place_from_surface", "275 mm", "250 mm", "Put place frame and board nearer")),
    ("one wire for two", {"claw": {"output": "0"}}, {}, ("output",)),
    ("a surface on its edge", {}, {"surface": {"place_from_surface": pose((0.0, 0.0, 60.0), (0.0, 80.0, 0.0))}},
     ("80 deg", "at most 45 deg", "z is up")),
]  # fmt: skip


@pytest.mark.parametrize(("config", "job", "says"), [row[1:] for row in REFUSED], ids=[row[0] for row in REFUSED])
def test_what_cannot_be_simulated_as_described_is_refused_in_the_first_second(
    tmp_path, config: Changes, job: Changes, says: tuple[str, ...]
):
    cell, own = described(tmp_path, config, job)
    begun = time.process_time()
    with pytest.raises(ConfigError) as refused:
        Cell.open(cell, sim="all", clock="virtual", job=own)
    assert time.process_time() - begun < 1.0
    for text in says:
        assert text in str(refused.value)


def test_a_mesh_that_is_seen_from_below_is_refused(tmp_path):
    write_saddle(tmp_path / "saddle.ply")
    mesh = trimesh.load_mesh(tmp_path / "saddle.ply")
    mesh.invert()
    mesh.export(tmp_path / "saddle.ply")
    job = {"surface": {"mesh": '"saddle.ply"', "mesh_unit": '"mm"'}}
    with pytest.raises(ConfigError, match=r"all of its triangles face down.*turn their order round"):
        drawing(tmp_path, None, job)


def test_a_part_that_the_calibration_would_bring_to_the_deck_is_refused_before_anything_moves(tmp_path):
    config = {
        "scan_camera": {"flange_from_camera": pose((60.0, 70.0, 80.0), (0.0, 0.0, 0.0))},
        "target_camera": {"flange_from_camera": pose((0.0, -100.0, 30.0), (0.0, 0.0, 180.0))},
    }
    cell, own = described(tmp_path, config)
    job, mesh = load_job(own)
    with pytest.raises(ConfigError, match=r"calibration view 4.*part and deck would come closer than 5 mm"):
        require_fit(job, load_config(cell), mesh, calibrates=True)


def test_the_collision_bodies_of_the_cell_hang_where_the_cameras_are(tmp_path):
    """A turned tool: what the planner keeps clear is where the world has cameras, laser and rail."""
    config: dict[str, dict[str, Any]] = {
        "scan_camera": {"flange_from_camera": pose((-50.0, -90.0, 80.0), (0.0, 5.0, 30.0))},
        "laser": {"baseline": '"60 mm"'},
        "rail": {"travel": '["-10 mm", "140 mm"]'},
    }
    cell, _ = described(tmp_path, config)
    head = next(body for body in tool_bodies(None, None, mounted(load_config(cell))) if body.name == "scan head")
    camera = about("z", 30.0) @ about("y", 5.0)
    for carriage in (-0.010, 0.140):
        for place in ((carriage, 0.0, 0.0), (carriage - 0.060, 0.0, 0.0)):
            point = camera @ np.array(place) + 1e-3 * np.array([-50.0, -90.0, 80.0])
            assert (np.abs(head.placement.actInv(point)) <= 0.5 * np.array(head.size) + 1e-9).all()
