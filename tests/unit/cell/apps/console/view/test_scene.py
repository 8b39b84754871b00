"""What the page draws of the cell is where the simulator, which the planner knows nothing of, has it."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from numpy.typing import NDArray

from cell.apps.console.view.scene import LINKS, MOST_POINTS, MOST_TRIANGLES, SceneNow, coarser, link_meshes, scene
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.gate.interlocks import Situation
from cell.motion.collision import BASE, PLACED, box, station_bodies
from drivers.errors import ConfigError
from sim_backends.models.arm_kinematics import UR10E_DH, Kinematics
from tests.support import ROOT

PAGE = ROOT / "cell" / "apps" / "console" / "page"
POSTURES = np.random.default_rng(5).uniform(-2.5, 2.5, (20, 6))


@pytest.fixture(scope="module")
def drawn() -> dict[str, Any]:
    made = scene(load_config(None), "pot")
    # What is not JSON, or no number, fails here.
    assert json.loads(json.dumps(made, allow_nan=False)) == made
    return made


def matrix(numbers: list[float]) -> NDArray[np.float64]:
    return np.array(numbers).reshape(4, 4)


def turned(drawn: dict[str, Any], joints: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The frames of the base, the six joints and the flange as the page puts them one into the other."""
    frames = [np.eye(4)]
    for pose, q in zip(drawn["arm"]["parent_from_joint"], joints, strict=True):
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(q), -np.sin(q)], [np.sin(q), np.cos(q)]]
        frames.append(frames[-1] @ matrix(pose) @ turn)
    return [*frames, frames[-1] @ matrix(drawn["arm"]["joint6_from_flange"])]


def test_the_drawn_flange_is_where_the_simulated_arm_has_it(drawn: dict[str, Any]):
    arm = Kinematics(UR10E_DH)
    for joints in POSTURES:
        np.testing.assert_allclose(turned(drawn, joints)[-1], arm.forward(joints), atol=1e-7)


def test_links_join_where_the_arm_bends(drawn: dict[str, Any]):
    """The capsules of upper arm and forearm meet in the elbow's, whatever the posture: each is in the right frame."""
    bodies = {body["name"]: body for body in drawn["bodies"]}

    def ends(name: str, frames: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        body = bodies[name]
        half = 0.5 * body["size"][2]
        there = frames[body["parent"]] @ matrix(body["placement"])
        return np.array([(there @ [0, 0, z, 1])[:3] for z in (-half, half)])

    for joints in POSTURES[:5]:
        frames = turned(drawn, joints)
        elbow = ends("elbow", frames)
        for link in ("upper arm", "forearm"):
            apart = np.linalg.norm(ends(link, frames)[:, None] - elbow[None], axis=2).min()
            assert apart < bodies["elbow"]["radius"]


def test_the_station_is_in_its_own_frame_and_the_surface_looks_like_its_mesh(drawn: dict[str, Any]):
    station, (job, _) = drawn["station"], load_job("pot")
    # Where the vehicle ends, the place is in reach in front of the arm; where it starts, it is not.
    reach = np.abs(UR10E_DH[:, :2]).sum()
    assert np.linalg.norm(matrix(station["base_from_place"])[:3, 3]) < 0.7 * reach
    place_from_base = matrix(station["place_from_start"]) @ matrix(drawn["vehicle_from_base"])
    assert np.linalg.norm(place_from_base[:3, 3]) > reach
    vertices = np.array(station["surface"]["vertices"]).reshape(-1, 3)
    triangles = np.array(station["surface"]["triangles"]).reshape(-1, 3)
    assert len(triangles) <= MOST_TRIANGLES and triangles.max() < len(vertices)
    np.testing.assert_allclose(np.ptp(vertices, axis=0)[:2], (0.070, 0.036), atol=5e-4)
    assert {body["name"] for body in station["bodies"]} >= {"table", "board", "board post"}
    np.testing.assert_allclose(next(b["size"] for b in drawn["bodies"] if b["name"] == "part"), job.grasp.size)


def test_a_mesh_is_made_coarser_without_leaving_its_place():
    x, y = np.meshgrid(np.linspace(0, 0.1, 201), np.linspace(0, 0.05, 101))
    sphere = np.sqrt(0.5**2 - (x - 0.05) ** 2 - (y - 0.025) ** 2)
    vertices = np.column_stack([x.ravel(), y.ravel(), sphere.ravel()])
    at = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    points, faces = coarser(vertices, triangles, 3000)
    assert 500 < len(faces) <= 3000
    off = np.linalg.norm(points - [0.05, 0.025, 0.0], axis=1) - 0.5
    assert np.abs(off).max() < 1e-4
    normals = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    assert (normals[:, 2] > 0).all()


class Moving:
    """A motion of the arm that goes on until it is told otherwise."""

    done = contact = False

    def wait(self, timeout: float) -> None:
        raise AssertionError("whoever draws waits for nothing")


def test_place_part_and_way_are_told_as_planner_and_steps_have_them():
    arm, rotation = Kinematics(UR10E_DH), pin.rpy.rpyToMatrix(0.02, -0.01, 0.7)
    situation = Situation(
        arm=None, vehicle=None, laser=None, claw=None, outputs={}, clear=lambda *_: [], postures={}, configuration="",
        forward=lambda joints: pin.SE3(arm.forward(np.asarray(joints))),
    )  # fmt: skip
    now = SceneNow()
    assert now.as_dict(situation) == {"place": None, "part": None, "path": None}
    base_from_place = pin.SE3(rotation, np.array([0.7, 0.1, 0.05]))
    base_from_part = base_from_place * pin.SE3(np.eye(3), np.array([0.0, 0.01, 0.012]))
    lying = base_from_part * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.010]))
    board = pin.SE3(np.eye(3), np.array([0.1, 0.3, 0.12]))
    situation.station = (*station_bodies(base_from_place, board), box(PLACED, BASE, lying, (0.07, 0.036, 0.02)))
    motion = Moving()
    situation.way, situation.last = np.linspace(POSTURES[0], POSTURES[1], 500), motion
    told = json.loads(json.dumps(now.as_dict(situation)))
    np.testing.assert_allclose(matrix(told["place"]), base_from_place.homogeneous, atol=1e-8)
    np.testing.assert_allclose(matrix(told["part"]), base_from_part.homogeneous, atol=1e-8)
    points = told["path"]["points"]
    assert len(points) <= MOST_POINTS
    for joints, point in ((POSTURES[0], points[0]), (POSTURES[1], points[-1])):
        np.testing.assert_allclose(point, arm.forward(joints)[:3, 3], atol=1e-4)
    motion.done = True
    assert now.as_dict(situation)["path"] is None


def test_without_a_job_there_is_neither_part_nor_station():
    bare = scene(load_config(None))
    assert bare["station"] is None
    assert "part" not in {body["name"] for body in bare["bodies"]}


def test_the_page_asks_nobody_else_and_has_nothing_inline():
    """Its policy is `default-src 'self'`: what is inline would not run, and what is elsewhere would not load."""
    html = (PAGE / "index.html").read_text(encoding="utf-8")
    assert not re.search(r"<script(?![^>]*\bsrc=)|<style|\bstyle=|\bon\w+=", html)
    names = re.findall(r'(?:src|href)="([^"]+)"', html)
    assert names
    assert all((PAGE / name.removeprefix("/static/")).is_file() for name in names)
    for file in PAGE.glob("*.*"):
        text = file.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert not re.search(r"https?://|@import|url\(|eval\(|new Function|innerHTML", text), file.name
        for imported in re.findall(r"from '([^']+)'", text):
            assert (PAGE / imported).is_file(), f"{file.name} imports {imported}"


def mesh_files(folder: Path, *names: str, size: float = 0.1) -> Path:
    """A folder of boxes under these names."""
    folder.mkdir(exist_ok=True)
    for name in names:
        trimesh.creation.box((size, size, size)).apply_translation((0.0, 0.0, size)).export(folder / name)
    return folder


def test_links_that_have_a_mesh_are_drawn_by_it_and_the_others_as_the_planner_has_them(tmp_path):
    folder = mesh_files(tmp_path / "meshes", "forearm.stl", "vehicle.ply")
    (folder / "README.txt").write_text("whose they are")
    made = scene(load_config(None), "pot", meshes=folder)
    assert json.loads(json.dumps(made, allow_nan=False)) == made
    forearm, vehicle = made["meshes"]
    assert (forearm["on"], vehicle["on"]) == ("forearm", "vehicle")
    corners = np.array(forearm["vertices"]).reshape(-1, 3)
    np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [[-0.05, -0.05, 0.05], [0.05, 0.05, 0.15]])
    arm = {body["name"]: body["parent"] for body in made["bodies"]}
    assert LINKS.index("forearm") not in arm.values()
    assert {"base", "upper arm", "wrist 1", "part", "claw"} <= set(arm)
    assert scene(load_config(None), "pot")["meshes"] == []


@pytest.mark.parametrize(
    ("files", "said"),
    [
        (("elbow.stl",), r"elbow\.stl belongs to no link; the names are base, shoulder.*vehicle"),
        (("forearm.stl", "forearm.ply"), r"forearm\.stl and forearm\.ply .* are the same link; keep one"),
        ((), r"holds no mesh"),
    ],
)
def test_a_folder_of_other_meshes_is_refused_by_name(tmp_path, files: tuple[str, ...], said: str):
    with pytest.raises(ConfigError, match=said):
        link_meshes(mesh_files(tmp_path, *files))


def test_a_mesh_in_millimetres_one_that_is_none_and_no_folder_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"measures 100 m \(allowed: 0\.005 to 5 m\); export it in metres"):
        link_meshes(mesh_files(tmp_path / "large", "base.stl", size=100.0))
    (tmp_path / "base.stl").write_bytes(b"solid nothing")
    with pytest.raises(ConfigError, match=r"base\.stl (cannot be read as a mesh|holds 0 triangles)"):
        link_meshes(tmp_path)
    with pytest.raises(ConfigError, match=r"the folder .*none cannot be read"):
        link_meshes(tmp_path / "none")
