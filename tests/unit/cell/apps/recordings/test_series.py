"""Promises on recordings as people have them: any spelling of a pose is read as it was meant, or asked for by name.

The pictures are warped by OpenCV, the poses written by numpy and scipy: neither comes from what is under test.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cell.apps.recordings import frames as recorded_frames
from cell.apps.recordings.command import Options, attach_poses, calibrate_folder
from cell.apps.recordings.conventions import TRIED, check_reading
from cell.apps.recordings.frames import RecordedFrame, read_frames
from cell.apps.recordings.series import in_order_of_views, list_folder, match_series, read_series
from cell.apps.recordings.solution import agreeing
from cell.measure.geometry.camera import CameraModel
from cell.measure.vision import LaserChannel, parse_board, read_colours
from cell.measure.vision.board.board import find_board
from cell.measure.vision.pictures import read_picture
from drivers.errors import ConfigError

BOARD = parse_board("chessboard:7x5:20mm")
SIZE = (640, 480)
CAMERA = CameraModel(*SIZE, 700.0, 700.0, 322.0, 238.0)
FLANGE_FROM_CAMERA = np.eye(4)
FLANGE_FROM_CAMERA[:3, :3] = Rotation.from_euler("xyz", (4, -7, 93), degrees=True).as_matrix()
FLANGE_FROM_CAMERA[:3, 3] = 0.05, -0.03, 0.08
BASE_FROM_BOARD = np.eye(4)
BASE_FROM_BOARD[:3, :3] = Rotation.from_euler("xyz", (178, 3, 20), degrees=True).as_matrix()
BASE_FROM_BOARD[:3, 3] = 0.45, -0.1, 0.02
VIEWS = (
    (0, 0, 0),
    (25, 5, 10),
    (-20, 15, -30),
    (8, -28, 60),
    (-15, -18, 120),
    (20, 22, -75),
    (-28, 4, 35),
    (5, 30, -140),
)


def flange_poses() -> list[np.ndarray]:
    """base_from_flange (4, 4) of each view of the board, in m."""
    poses = []
    for k, angles in enumerate(VIEWS):
        camera_from_board = np.eye(4)
        camera_from_board[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        middle = camera_from_board[:3, :3] @ (0.06, 0.04, 0)
        camera_from_board[:3, 3] = np.array([0.01 * (k % 3 - 1), 0.008 * (k % 2), 0.42 + 0.02 * (k % 4)]) - middle
        poses.append(BASE_FROM_BOARD @ np.linalg.inv(camera_from_board) @ np.linalg.inv(FLANGE_FROM_CAMERA))
    return poses


POSES = flange_poses()


def photograph(base_from_flange: np.ndarray) -> np.ndarray:
    """The board as CAMERA sees it, warped at four times the size and averaged."""
    cell, half = 40, 20
    squares = np.indices((6, 8)).sum(axis=0) % 2 * 200 + 25
    sheet = np.full((6 * cell + 2 * cell, 8 * cell + 2 * cell), 225, np.uint8)
    sheet[cell:-cell, cell:-cell] = np.kron(squares, np.ones((cell, cell)))
    camera_from_board = np.linalg.inv(FLANGE_FROM_CAMERA) @ np.linalg.inv(base_from_flange) @ BASE_FROM_BOARD
    # Pixels of the sheet to metres on the board: its first inner corner lies at (2, 2) squares, edges between pixels.
    metres = np.diag([0.02 / cell, 0.02 / cell, 1.0])
    metres[:2, 2] = -0.04 + 0.5 * 0.02 / cell
    into = CAMERA.matrix @ camera_from_board[:3, [0, 1, 3]] @ metres
    large = np.diag([4.0, 4.0, 1.0])
    large[:2, 2] = 1.5
    wide = cv2.warpPerspective(sheet, large @ into, (4 * SIZE[0], 4 * SIZE[1]), flags=cv2.INTER_LINEAR, borderValue=90)
    assert half * 2 == cell
    return cv2.resize(cv2.GaussianBlur(wide, (0, 0), 2.5), SIZE, interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    for k, pose in enumerate(POSES):
        cv2.imwrite(str(folder / f"frame{k + 3:02d}.png"), photograph(pose))
    return folder


@pytest.fixture(scope="module")
def seen(pictures) -> dict[str, RecordedFrame]:
    frames, _ = read_frames(list_folder(pictures), BOARD)
    assert all(f.reason is None for f in frames), [f.text for f in frames]
    return {f.name: f for f in frames}


@pytest.fixture
def recording(tmp_path, pictures) -> Path:
    for path in pictures.iterdir():
        (tmp_path / path.name).symlink_to(path)
    return tmp_path


def matched(folder: Path):
    """The listing, the series of its pictures, and the links and what was not read of a folder."""
    listing = list_folder(folder)
    series, links, unread = read_series(listing)
    belonging, strange = match_series(series, listing, links)
    return listing, belonging, links, [*listing.unread, *unread, *strange]


def understand(folder: Path, seen: dict[str, RecordedFrame], **said: str):
    """Frames with their poses as the product understands them, what it says about them, and what it did not read."""
    listing, belonging, _, unread = matched(folder)
    frames = [RecordedFrame(p, listing.name(p), seen[p.name].view) for p in listing.pictures]
    return frames, attach_poses(frames, belonging, CAMERA, Options(**said)), unread


def quaternion(pose: np.ndarray, order: str = "xyzw") -> list[float]:
    q = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return (q if order == "xyzw" else q[[3, 0, 1, 2]]).tolist()


def one_file_each(folder: Path, text: Callable[[np.ndarray], str], name: str = "pose{:02d}.txt") -> None:
    for k, pose in enumerate(POSES):
        path = folder / name.format(k + 3)
        path.parent.mkdir(exist_ok=True)
        path.write_text(text(pose))


def row(values, separator: str = " ") -> str:
    return separator.join(f"{v:.9f}" for v in np.ravel(values))


def angles(pose: np.ndarray, kind: str = "rotvec", degrees: bool = False) -> np.ndarray:
    rotation = Rotation.from_matrix(pose[:3, :3])
    return rotation.as_rotvec() if kind == "rotvec" else rotation.as_euler(kind, degrees=degrees)


def tuples(folder: Path) -> None:
    one_file_each(folder, lambda p: str((tuple(p[:3, 3]), tuple(quaternion(p)))))


def of_each(text: Callable[[int, np.ndarray], str], between: str = "\n") -> str:
    """The text of each pose with the number of its picture."""
    return between.join(text(k + 3, p) for k, p in enumerate(POSES))


def yaml_in_a_sub_folder(folder: Path) -> None:
    def text(p: np.ndarray) -> str:
        x, y, z, w = quaternion(p)
        t = "".join(f"  {n}: {v:.9f}\n" for n, v in zip("xyz", p[:3, 3], strict=True))
        return f"position:\n{t}orientation: {{x: {x:.9f}, y: {y:.9f},\n  z: {z:.9f}, w: {w:.9f}}}\n"

    one_file_each(folder, text, "poses/{:d}.yaml")


def numpy_stack_by_columns(folder: Path) -> None:
    np.save(folder / "poses.npy", np.array([p.T for p in POSES]))


def halves_in_one_file(folder: Path) -> None:
    """As OpenCV's hand-eye solvers take them, with what they are to give beside."""
    turns, places = np.array([p[:3, :3] for p in POSES]), np.array([p[:3, 3:] for p in POSES])
    np.savez(folder / "calib.npz", R_gripper2base=turns, t_gripper2base=places, camera_matrix=CAMERA.matrix)


def joints_and_pose(k: int, p: np.ndarray) -> str:
    joints = "".join(f"<joint{j}>{10 * j + k}.5</joint{j}>" for j in range(1, 7))
    values = [*1e3 * p[:3, 3], *angles(p, "xyz")]
    pose = "".join(f"<pose{j + 1}>{v:.9f}</pose{j + 1}>" for j, v in enumerate(values))
    return f'<stop name="{11 - k}"><picture>./images/frame{k:02d}.png</picture>{joints}{pose}</stop>'


JOINTS = np.random.default_rng(0).normal(0, 1.5, (len(POSES) + 3, 6))
NAMES = " ".join([*(f"actual_q_{k}" for k in range(6)), *(f"actual_TCP_pose_{k}" for k in range(6))])
PROGRAM = "def photographs():\n  set_tcp(p[0, 0, 0.1, 0, 0, 0])\n  movej([0.1, -1.5, 1.5, -1.5, -1.5, 0])\n"
LINKS = [
    {"image": f"frame{k + 3:02d}.png", "tf": {f"link{j}": (p if j == 6 else POSES[0]).tolist() for j in range(1, 7)}}
    for k, p in enumerate(POSES)
]
LIST = [{"image": f"frame{k + 3:02d}.png", "robot": p.tolist(), "joints": [0.1] * 6} for k, p in enumerate(POSES)]
TEXTS = {
    "wxyz in mm with names": (
        "robot.csv",
        "image,a1,a2,a3,a4,a5,a6,a7\n"
        + of_each(lambda k, p: f"frame{k:02d}.png,{row([*1e3 * p[:3, 3], *quaternion(p, 'wxyz')], ',')}"),
    ),
    "named columns in another order": (
        "robot.csv",
        "frame;qw;qx;qy;qz;x;y;z\n"
        + "\n".join(of_each(lambda k, p: row([k, *quaternion(p, "wxyz"), *p[:3, 3]], ";")).split("\n")[::-1]),
    ),
    "decimal commas with bom and crlf": (
        "Stützpunkte.csv",
        "\ufeff" + of_each(lambda k, p: row([*1e3 * p[:3, 3], *angles(p, "ZYX", True)], ";").replace(".", ","), "\r\n"),
    ),
    "json list": ("data.json", json.dumps(LIST[::-1])),
    "links of which one is the flange": ("poses.json", json.dumps(LINKS)),
    "opencv yaml": (
        "robot.yml",
        "%YAML:1.0\n---\n"
        + of_each(
            lambda k, p: (
                f"pose{k}: !!opencv-matrix\n   rows: 3\n   cols: 4\n   dt: d\n   data: [ {row(p[:3], ', ')} ]\n"
            )
        ),
    ),
    "opencv xml": (
        "robot.xml",
        '<?xml version="1.0"?>\n<opencv_storage>'
        + of_each(
            lambda k, p: (
                f'<pose_{k} type_id="opencv-matrix"><rows>4</rows><cols>4</cols><dt>d</dt><data>\n{row(p)}</data>'
                f"</pose_{k}>"
            )
        )
        + "</opencv_storage>",
    ),
    "xml with joints beside": ("robot.xml", f"<stops>{of_each(joints_and_pose)}</stops>"),
    "times before rotation vectors": ("poses.txt", of_each(lambda k, p: row([1.7e9 + 3.7 * k, *p[:3, 3], *angles(p)]))),
    "titles above rotation and position": (
        "info.txt",
        of_each(lambda k, p: f"{k}:\nRotation:\n{angles(p).tolist()}\nTranslation:\n{p[:3, 3].tolist()}\n"),
    ),
    "program of the arm": (
        "photographs.script",
        PROGRAM
        + of_each(lambda k, p: f"  movel(p[{row([*p[:3, 3], *angles(p)], ', ')}], a=1.2, v=0.25)\n  sleep(0.5)")
        + "\nend\n",
    ),
    "as the arm's client records them": (
        "robot_data.csv",
        f"timestamp {NAMES}\n" + of_each(lambda k, p: row([100.0 + k, *JOINTS[k], *p[:3, 3], *angles(p)])),
    ),
}
SPELLINGS = {
    halves_in_one_file: ("matrix-4x4", "m", "order"),
    tuples: ("xyz+quaternion-xyzw", "m", "name"),
    yaml_in_a_sub_folder: ("xyz+quaternion-xyzw", "m", "name"),
    numpy_stack_by_columns: ("matrix-4x4-by-columns", "m", "order"),
    "opencv xml": ("matrix-4x4", "m", "name"),
    "xml with joints beside": ("xyz+rpy-rad", "mm", "name"),
    "wxyz in mm with names": ("xyz+quaternion-wxyz", "mm", "name"),
    "named columns in another order": ("xyz+quaternion-xyzw", "m", "number"),
    "decimal commas with bom and crlf": ("xyz+abc-deg", "mm", "order"),
    "json list": ("matrix-4x4", "m", "name"),
    "opencv yaml": ("matrix-4x4", "m", "name"),
    "program of the arm": ("xyz+rotvec-rad", "m", "order"),
    "times before rotation vectors": ("xyz+rotvec-rad", "m", "order"),
    "titles above rotation and position": ("xyz+rotvec-rad", "m", "name"),
    "as the arm's client records them": ("xyz+rotvec-rad", "m", "order"),
    "links of which one is the flange": ("matrix-4x4", "m", "name"),
}


def write(folder: Path, spelling: str | Callable[[Path], None]) -> None:
    if isinstance(spelling, str):
        name, text = TEXTS[spelling]
        (folder / name).write_bytes(text.encode())
    else:
        spelling(folder)


@pytest.mark.parametrize("spelling", SPELLINGS, ids=lambda w: w if isinstance(w, str) else w.__name__)
def test_poses_are_read_as_they_were_meant(recording, seen, spelling):
    write(recording, spelling)
    frames, understood, unread = understand(recording, seen)
    assert understood.notes == [], unread
    about = understood.about
    assert (about["reading"], about["unit"], about["matched_by"]) == SPELLINGS[spelling]
    assert about["setup"] == "eye_in_hand"
    assert about["turn_deg"] < 0.1
    assert about["shift_mm"] < 0.5
    for frame, pose in zip(frames, POSES, strict=True):
        assert np.abs(frame.base_from_flange.homogeneous - pose).max() < 1e-6


# By scipy, beside the table of the product.
TURNS = {
    "quaternion-wxyz": lambda r: r.as_quat()[[3, 0, 1, 2]],
    "rpy-rad": lambda r: r.as_euler("xyz"),
    "zyz-deg": lambda r: r.as_euler("ZYZ", degrees=True),
    "zyx-deg": lambda r: r.as_euler("zyx", degrees=True),
    "rotvec-deg": lambda r: np.degrees(r.as_rotvec()),
    "XYZ-rad": lambda r: r.as_euler("XYZ"),
}


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("kind", TURNS)
def test_a_convention_of_the_table_is_found_and_another_is_read_when_it_is_named(recording, seen, kind, first):
    turns = [TURNS[kind](Rotation.from_matrix(p[:3, :3])) for p in POSES]
    rows = [row(np.r_[t, p[:3, 3]] if first else np.r_[p[:3, 3], t]) for p, t in zip(POSES, turns, strict=True)]
    (recording / "poses.txt").write_text("\n".join(rows))
    name = f"{kind}+xyz" if first else f"xyz+{kind}"
    check_reading(name)
    _, alone, _ = understand(recording, seen)
    frames, asked, _ = understand(recording, seen, poses=name)
    assert all(np.abs(f.base_from_flange.homogeneous - p).max() < 1e-6 for f, p in zip(frames, POSES, strict=True))
    assert asked.about["reading"] == name
    assert alone.about.get("reading") == name if name in TRIED else "--poses" in alone.refused


@pytest.mark.parametrize("name", ["xyz+abc", "rotvec-rad", "xyz+XXZ-deg", "xyz+rpy-deg+xyz", "matrix-3x4"])
def test_a_name_of_no_convention_is_refused_with_the_form(name):
    with pytest.raises(ConfigError, match=r"allowed is xyz\+KIND"):
        check_reading(name)


def test_a_folder_for_each_pose_is_read(tmp_path, pictures, seen):
    for k, (path, pose) in enumerate(zip(sorted(pictures.iterdir()), POSES, strict=True)):
        folder = tmp_path / f"pose_{k + 1:02d}"
        folder.mkdir()
        (folder / "image.png").symlink_to(path)
        (folder / "data.json").write_text(json.dumps({"stamp": k, "robot": [*pose[:3, 3], *quaternion(pose)]}))
    listing, belonging, _, _ = matched(tmp_path)
    views = [seen[path.name].view for path in sorted(pictures.iterdir())]
    frames = [RecordedFrame(p, listing.name(p), v) for p, v in zip(listing.pictures, views, strict=True)]
    assert attach_poses(frames, belonging, CAMERA, Options()).about["matched_by"] == "folder"
    assert all(np.abs(f.base_from_flange.homogeneous - p).max() < 1e-6 for f, p in zip(frames, POSES, strict=True))


def test_a_camera_that_stands_before_the_arm_is_recognised(recording, seen):
    one_file_each(recording, lambda p: row(np.linalg.inv(p).ravel()))
    _, understood, _ = understand(recording, seen)
    assert understood.setup == "eye_to_hand"
    assert "eye in hand" in understood.about["evidence"]


def test_two_fields_that_both_agree_are_asked_for(recording, seen):
    tool = np.eye(4)
    tool[:3, 3] = 0, 0.02, 0.15
    both = [
        {"file": f"frame{k + 3:02d}.png", "flange": p.tolist(), "tcp": (p @ tool).tolist()} for k, p in enumerate(POSES)
    ]
    (recording / "both.json").write_text(json.dumps(both))
    frames, understood, _ = understand(recording, seen)
    assert "--pose-field" in understood.refused
    assert all(f.base_from_flange is None for f in frames)
    (name,) = [w.rstrip(";,") for w in understood.refused.split() if w.startswith("both.json") and "flange" in w]
    frames, understood, _ = understand(recording, seen, pose_field=name)
    assert np.abs(frames[0].base_from_flange.homogeneous - POSES[0]).max() < 1e-6
    with pytest.raises(ConfigError, match="no such poses"):
        understand(recording, seen, pose_field="tcp2")


def boards_poses(turned: bool) -> list[np.ndarray]:
    """camera_from_board of each view, or its inverse, as somebody's detector gave them."""
    poses = [np.linalg.inv(FLANGE_FROM_CAMERA) @ np.linalg.inv(p) @ BASE_FROM_BOARD for p in POSES]
    return [np.linalg.inv(p) if turned else p for p in poses]


@pytest.mark.parametrize("turned", [False, True])
def test_the_boards_poses_beside_the_pictures_are_not_taken_for_the_flanges(recording, seen, turned):
    # They agree with the pictures better than any arm's.
    for k, pose in enumerate(boards_poses(turned)):
        (recording / f"board{k + 3:02d}.txt").write_text(row(np.r_[1.03 * pose[:3, 3], quaternion(pose)]))
    _, alone, _ = understand(recording, seen)
    assert "those of the board as the camera sees it" in alone.refused
    tuples(recording)
    frames, understood, _ = understand(recording, seen)
    assert not understood.refused
    assert "boardN.txt not used: its poses are those of the board" in " ".join(understood.notes)
    assert understood.about["source"] == ["poseN.txt"]
    assert all(np.abs(f.base_from_flange.homogeneous - p).max() < 1e-6 for f, p in zip(frames, POSES, strict=True))


def test_a_wrong_pitch_is_named_with_the_right_one(recording, seen):
    one_file_each(recording, lambda p: row(np.vstack([np.c_[p[:3, :3], 1.25 * p[:3, 3]], p[3:]]).ravel()))
    frames, understood, _ = understand(recording, seen)
    assert "25.0" in understood.refused
    assert all(f.base_from_flange is None for f in frames)


def test_poses_of_other_pictures_agree_in_no_reading(recording, seen):
    for k, pose in enumerate(POSES[::-1]):
        (recording / f"pose{k + 3:02d}.txt").write_text(row(pose.ravel()))
    _, understood, _ = understand(recording, seen)
    assert "are they the poses of these pictures" in understood.refused


@pytest.mark.parametrize(("a", "b"), [(0, 3), (2, 6)])
def test_two_exchanged_poses_of_seven_do_not_hide_the_reading(recording, seen, a, b):
    """The frames that are left give the reading; the two are named by what compares the turns."""
    for k in range(7, len(POSES)):
        (recording / f"frame{k + 3:02d}.png").unlink()
    for k in range(7):
        pose = POSES[{a: b, b: a}.get(k, k)]
        (recording / f"pose{k + 3:02d}.txt").write_text(row(pose.ravel()))
    frames, understood, _ = understand(recording, seen)
    assert not understood.refused, understood.refused
    kept = agreeing(frames, CAMERA)
    assert len(kept) == 5
    assert {f.name for f in frames if f not in kept} == {f"frame{k + 3:02d}.png" for k in (a, b)}


def test_one_pose_in_another_unit_is_named(recording, seen):
    one_file_each(recording, lambda p: row([*p[:3, 3], *quaternion(p)]))
    p = POSES[4]
    (recording / "pose07.txt").write_text(row([*(1e3 * p[:3, 3]), *quaternion(p)]))
    frames, understood, _ = understand(recording, seen)
    assert not understood.refused, understood.refused
    assert "pose07.txt" in frames[4].text
    assert "another unit" in frames[4].text
    others = [f for f in frames if f is not frames[4]]
    assert all(f.reason is None and f.base_from_flange is not None for f in others)


def test_the_quick_search_of_a_plan_finds_the_same_boards(pictures, seen):
    listing = list_folder(pictures)
    found = [read_frames(listing, BOARD, laser=None, quick=quick)[0] for quick in (False, True)]
    for fine, rough in zip(*found, strict=True):
        assert np.array_equal(fine.view.ids, rough.view.ids)
        assert 0 < np.abs(fine.view.pixels - rough.view.pixels).max() < 0.5


def test_a_plan_is_made_by_the_quick_search(recording, monkeypatch):
    tuples(recording)
    asked: list[bool] = []

    def find(image, spec, quick):
        asked.append(quick)
        return find_board(image, spec, quick=quick)

    monkeypatch.setattr(recorded_frames, "find_board", find)
    plan = calibrate_folder(recording, BOARD, Options(plan=True))
    assert asked == [True] * len(POSES)
    assert (plan["poses"]["reading"], plan["intrinsics"]) == ("xyz+quaternion-xyzw", None)
    assert plan["poses"]["turn_deg"] < 0.2


def test_without_a_board_the_folders_with_pictures_are_named(tmp_path, pictures):
    (tmp_path / "left").symlink_to(pictures)
    with pytest.raises(ConfigError, match=r"8 pictures with --board.*pictures are in left \(8\)"):
        calibrate_folder(tmp_path, None)


def test_times_match_poses_to_pictures(tmp_path, pictures, seen):
    names, rows = {}, []
    for k, (path, pose) in enumerate(zip(sorted(pictures.iterdir()), POSES, strict=True)):
        name = f"{1690000000 + 2 * k}.250.png"
        (tmp_path / name).symlink_to(path)
        names[name] = seen[path.name]
        rows.append(row([1690000000 + 2 * k + 0.2, *pose[:3, 3], *quaternion(pose)]))
        rows.append(row([1690000000 + 2 * k + 1.2, *(pose[:3, 3] + 0.1), *quaternion(pose)]))
    for unknown in ("", "time,x,y,z,qx,qy,qz,qw\nn/a," + row([0.1] * 7, ",") + "\n"):
        separator = "," if unknown else " "
        text = "\n".join(r.replace(" ", separator) for r in rows)
        (tmp_path / "trajectory.txt").write_text((unknown or "# timestamp tx ty tz qx qy qz qw\n") + text)
        frames, understood, _ = understand(tmp_path, names)
        assert understood.about["matched_by"] == "time"
        for frame, pose in zip(frames, POSES, strict=True):
            assert np.abs(frame.base_from_flange.homogeneous - pose).max() < 1e-6


def test_a_picture_whose_file_says_that_it_was_held_turned_is_read_as_the_sensor_has_it(tmp_path, pictures):
    path = tmp_path / "turned.jpg"
    image = cv2.imread(str(pictures / "frame03.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(path), image)
    as_it_is, data = read_picture(path), path.read_bytes()
    for orientation in (3, 6):
        tag = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + bytes([orientation, 0, 0, 0]) + bytes(4)
        path.write_bytes(data[:2] + b"\xff\xe1" + (len(tag) + 2).to_bytes(2, "big") + tag + data[2:])
        assert np.array_equal(read_picture(path), as_it_is)
        assert np.array_equal(read_colours(path), as_it_is)


def test_what_is_wrong_is_named_with_its_file(recording, seen):
    tuples(recording)
    (recording / "pose04.txt").write_text("((0.4, nan, 0.5), (0, 0, 0, 1))")
    (recording / "pose05.txt").write_text("")
    (recording / "pose06.txt").write_text("0.1 0.2 0.3")
    (recording / "pose07.txt").unlink()
    (recording / "pose88.txt").write_text(str((tuple(POSES[0][:3, 3]), tuple(quaternion(POSES[0])))))
    (recording / "pictures.zip").write_bytes(b"PK")
    (recording / ".DS_Store").write_bytes(b"\0")
    (recording / "gone.png").symlink_to(recording / "nowhere.png")
    frames, understood, unread = understand(recording, seen)
    assert understood.about["reading"] == "xyz+quaternion-xyzw"
    assert "pose04.txt: it holds values that are not finite" in frames[1].text
    assert [f.name for f in frames if f.base_from_flange is None] == [f"frame{n:02d}.png" for n in (4, 5, 6, 7)]
    reasons = dict(unread)
    assert "empty" in reasons["pose05.txt"]
    assert "3 numbers" in reasons["pose06.txt"]
    assert "archive" in reasons["pictures.zip"]
    assert "hidden" in reasons[".DS_Store"]
    assert "not there" in reasons["gone.png"]


def test_a_folder_of_several_recordings_is_refused(tmp_path, pictures):
    for session in ("monday", "tuesday"):
        (tmp_path / session).mkdir()
        for path in pictures.iterdir():
            (tmp_path / session / path.name).symlink_to(path)
        tuples(tmp_path / session)
    with pytest.raises(ConfigError, match="monday, tuesday"):
        matched(tmp_path)
    for path in (tmp_path / "monday").iterdir():
        path.rename(tmp_path / path.name)
    listing, (own,), _, _ = matched(tmp_path)
    assert len(own.of) == len(listing.pictures) == len(POSES)
    assert ("tuesday/", "a recording of its own: name it with --from") in listing.unread


@pytest.mark.parametrize("seed", range(4))
def test_spoilt_texts_raise_nothing_but_their_reason(recording, seed):
    rng = np.random.default_rng(seed)
    for spelling in SPELLINGS:
        write(recording, spelling)
    for path in [p for p in recording.rglob("*") if p.suffix in (".txt", ".csv", ".yaml", ".yml", ".json")]:
        data = bytearray(path.read_bytes())
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.choice(list(b"[]{}:,;-.\n \0\xffx'\"09"))
        path.write_bytes(bytes(data[: rng.integers(1, len(data) + 1)]))
    _, _, unread = read_series(list_folder(recording))
    assert all(len(reason) > 5 for _, reason in unread)


def drawn_corners(image: np.ndarray, view) -> np.ndarray:
    return cv2.drawChessboardCorners(image, view.spec.grid, view.pixels.astype(np.float32), True)


def drawn_axes(image: np.ndarray, view) -> np.ndarray:
    pose = np.linalg.inv(FLANGE_FROM_CAMERA) @ np.linalg.inv(POSES[1]) @ BASE_FROM_BOARD
    turn = cv2.Rodrigues(pose[:3, :3])[0]
    return cv2.drawFrameAxes(image, CAMERA.matrix, np.zeros(5), turn, pose[:3, 3], 0.06, 2)


def drawn_circles(image: np.ndarray, view) -> np.ndarray:
    for point in view.pixels:
        cv2.circle(image, np.round(point).astype(int).tolist(), 4, (0, 255, 0), 1)
    return image


@pytest.mark.parametrize("kind", [".png", ".jpg"])
@pytest.mark.parametrize("draw", [drawn_corners, drawn_axes, drawn_circles])
def test_pictures_that_a_program_drew_into_are_set_aside_by_their_pixels(tmp_path, pictures, seen, draw, kind):
    """The names say nothing, and one that misleads: a view of its own is called corners."""
    for name, target in (("frame03.png", "corners.png"), ("frame04.png", "b.png"), ("frame05.png", "c.png")):
        (tmp_path / target).symlink_to(pictures / name)
    image = draw(
        cv2.cvtColor(cv2.imread(str(pictures / "frame04.png"), 0), cv2.COLOR_GRAY2BGR), seen["frame04.png"].view
    )
    cv2.imwrite(str(tmp_path / f"a{kind}"), image)
    frames, _ = read_frames(list_folder(tmp_path), BOARD, laser=None)
    assert {f.name: f.text for f in frames if f.reason is not None} == {
        f"a{kind}": "it is b.png with lines drawn into it"
    }


def test_pictures_without_colour_are_not_compared_in_full(tmp_path, pictures, monkeypatch):
    """Dark ones look alike when small; to compare each two of them took most of a plan's time."""
    image = cv2.imread(str(pictures / "frame04.png"), cv2.IMREAD_GRAYSCALE)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.roll(image // 2, 3 * k, axis=1))
    monkeypatch.setattr(recorded_frames, "_drawn_into", lambda *_: pytest.fail("compared in full"))
    frames, _ = read_frames(list_folder(tmp_path), BOARD, laser=None)
    assert [f.reason for f in frames] == [None] * 3


def test_poses_that_name_no_picture_belong_to_those_that_are_left(tmp_path, pictures):
    """Cropped copies lie beside the pictures: they take no pose."""
    (tmp_path / "poses.txt").write_text("\n".join(row([*p[:3, 3], *quaternion(p)]) for p in POSES[:5]))
    for k, path in enumerate(sorted(pictures.iterdir())[:5]):
        (tmp_path / f"{k}.png").symlink_to(path)
        cv2.imwrite(str(tmp_path / f"Calibrated{k}.png"), cv2.imread(str(path), 0)[6:-6, 8:-8])
    listing = list_folder(tmp_path)
    (poses,), _, _ = read_series(listing)
    assert matched(tmp_path)[1] == []
    frames, _ = read_frames(listing, BOARD, laser=None)
    assert in_order_of_views(poses, frames)
    assert attach_poses(frames, [poses], CAMERA, Options()).about["turn_deg"] < 0.1


def test_a_picture_with_the_laser_is_not_taken_for_one_that_was_drawn_into(tmp_path, pictures):
    image = cv2.imread(str(pictures / "frame04.png"), cv2.IMREAD_GRAYSCALE) * 0.8
    cv2.imwrite(str(tmp_path / "a.png"), image)
    cv2.imwrite(str(tmp_path / "b.png"), lit(image, 200))
    frames, _ = read_frames(list_folder(tmp_path), BOARD)
    assert [(f.name, f.reason and f.reason.value) for f in frames] == [("a.png", None), ("b.png", "laser_picture")]


def test_a_copy_under_another_number_counts_once_and_with_another_pose_it_is_refused(recording):
    (recording / "frame11.png").symlink_to(recording / "frame03.png")
    image = cv2.imread(str(recording / "frame04.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(recording / "frame12.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 90])
    (recording / "frame13.png").symlink_to(recording / "frame05.png")
    rows = [row(p.ravel()) for p in [*POSES, POSES[0], POSES[1], POSES[7]]]
    (recording / "poses.txt").write_text("\n".join(rows))
    listing, belonging, links, _ = matched(recording)
    frames, _ = read_frames(listing, BOARD, links)
    attach_poses(frames, belonging, CAMERA, Options())
    assert [f.reason for f in frames[: len(POSES)]] == [None] * len(POSES)
    same, again, other = frames[len(POSES) :]
    assert (same.reason.value, same.text) == ("duplicate", "the same file as frame03.png")
    assert (again.reason.value, again.text) == ("duplicate", "it shows what frame04.png shows")
    assert other.reason.value == "no_pose"
    assert "frame05.png" in other.text


def test_a_damaged_file_beside_the_poses_is_named_and_the_others_are_read(recording, seen):
    tuples(recording)
    (recording / "old.npz").write_bytes(b"PK\x03\x04junk")
    (recording / "old.npy").write_bytes(b"")
    (recording / "camera.json").write_text('{"rows": null, "cols": 4, "data": [1, 2]}')
    (recording / "deep.json").write_text("[" * 5000)
    frames, understood, unread = understand(recording, seen)
    assert understood.notes == []
    assert all(f.base_from_flange is not None for f in frames)
    reasons = dict(unread)
    assert reasons.keys() == {"old.npz", "old.npy", "camera.json", "deep.json"}
    assert "zip" in reasons["old.npz"]
    assert "no pose" in reasons["camera.json"]


def test_the_laser_in_a_second_picture_is_found_by_name(tmp_path, pictures):
    (tmp_path / "laser").mkdir()
    for path in sorted(pictures.iterdir())[:2]:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(tmp_path / f"board_{path.stem[-2:]}.png"), image)
        dark = np.random.default_rng(1).normal(6, 1, image.shape)
        across = np.arange(image.shape[1]) - (300 + 0.1 * np.arange(image.shape[0]))[:, None]
        dark += 180 * np.exp(-0.5 * (across / 2.0) ** 2)
        cv2.imwrite(str(tmp_path / "laser" / f"{int(path.stem[-2:])}.png"), np.clip(dark, 0, 255).astype(np.uint8))
    frames, _ = read_frames(list_folder(tmp_path), BOARD)
    assert [(f.name, f.stripe_from) for f in frames if f.reason is None] == [
        ("board_03.png", "laser/3.png"),
        ("board_04.png", "laser/4.png"),
    ]
    rows = frames[0].profile.rows
    assert np.abs(frames[0].profile.centres[rows] - (300 + 0.1 * rows)).max() < 0.2
    assert [f.reason.value for f in frames if f.reason is not None] == ["laser_picture"] * 2


def lit(image: np.ndarray, red: float) -> np.ndarray:
    """A picture (h, w) with a red laser line on it, in colour, blue first; on white it is as bright as the paper."""
    across = np.arange(image.shape[1]) - (300 + 0.1 * np.arange(image.shape[0]))[:, None]
    stripe = np.exp(-0.5 * (across / 2.0) ** 2)
    colour = np.repeat(image[:, :, None].astype(float), 3, axis=2)
    colour[:, :, 2] += red * stripe
    colour[:, :, :2] -= 0.35 * red * stripe[:, :, None]
    return np.clip(np.rint(colour + np.random.default_rng(5).normal(0, 1, colour.shape)), 0, 255).astype(np.uint8)


def test_a_red_laser_on_white_paper_is_read_in_colour_and_never_wrongly_in_grey(tmp_path, pictures):
    for path in sorted(pictures.iterdir())[:2]:
        cv2.imwrite(str(tmp_path / path.name), lit(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) * 0.8, 60))
    frames, channel = read_frames(list_folder(tmp_path), BOARD)
    assert channel.chosen is not LaserChannel.GREY
    assert sum(channel.votes.values()) == 2
    for frame in frames:
        assert frame.profile is not None, frame.stripe_text
        rows = frame.profile.rows
        assert np.median(np.abs(frame.profile.centres[rows] - (300 + 0.1 * rows))) < 0.3
    in_grey, _ = read_frames(list_folder(tmp_path), BOARD, laser=LaserChannel.GREY)
    for frame in in_grey:
        if frame.profile is not None:
            rows = frame.profile.rows
            assert np.median(np.abs(frame.profile.centres[rows] - (300 + 0.1 * rows))) < 2.0


def test_the_picture_without_the_laser_is_taken_off(tmp_path, pictures):
    for path in sorted(pictures.iterdir())[:2]:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) * 0.8
        cv2.imwrite(str(tmp_path / f"{path.stem[-2:]}_off.png"), image)
        cv2.imwrite(str(tmp_path / f"{path.stem[-2:]}_on.png"), lit(image, 40).max(axis=2))
    frames, _ = read_frames(list_folder(tmp_path), BOARD)
    used = [f for f in frames if f.reason is None]
    assert [(f.name, f.stripe_from, f.stripe_off) for f in used] == [
        ("03_off.png", "03_on.png", "03_off.png"),
        ("04_off.png", "04_on.png", "04_off.png"),
    ]
    for frame in used:
        rows = frame.profile.rows
        assert len(rows) > 200
        assert np.median(np.abs(frame.profile.centres[rows] - (300 + 0.1 * rows))) < 0.3
