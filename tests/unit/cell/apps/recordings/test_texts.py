"""Promises on poses as people have them: any spelling is read as it was meant, and what is broken is named."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cell.apps.recordings.series import list_folder, read_series
from cell.apps.recordings.texts import read_content
from tests.unit.cell.apps.recordings.pictures import (
    CAMERA,
    POSES,
    angles,
    of_each,
    one_file_each,
    quaternion,
    row,
    tuples,
    understand,
)


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
PRINTED = str.maketrans(".-", ",\u2212")
# File and text, or what writes it; then reading, unit, and what matches poses and pictures.
SPELLINGS: dict[str, tuple[str | Callable[[Path], None], str, tuple[str, str, str]]] = {
    "halves_in_one_file": (halves_in_one_file, "", ("matrix-4x4", "m", "order")),
    "tuples": (tuples, "", ("xyz+quaternion-xyzw", "m", "name")),
    "yaml_in_a_sub_folder": (yaml_in_a_sub_folder, "", ("xyz+quaternion-xyzw", "m", "name")),
    "numpy_stack_by_columns": (numpy_stack_by_columns, "", ("matrix-4x4-by-columns", "m", "order")),
    "wxyz in mm with names": (
        "robot.csv",
        "image,a1,a2,a3,a4,a5,a6,a7\n"
        + of_each(lambda k, p: f"frame{k:02d}.png,{row([*1e3 * p[:3, 3], *quaternion(p, 'wxyz')], ',')}"),
        ("xyz+quaternion-wxyz", "mm", "name"),
    ),
    "named columns in another order": (
        "robot.csv",
        "frame;qw;qx;qy;qz;x;y;z\n"
        + "\n".join(of_each(lambda k, p: row([k, *quaternion(p, "wxyz"), *p[:3, 3]], ";")).split("\n")[::-1]),
        ("xyz+quaternion-xyzw", "m", "number"),
    ),
    "decimal commas with bom and crlf": (
        "Stützpunkte.csv",
        "\ufeff" + of_each(lambda k, p: row([*1e3 * p[:3, 3], *angles(p, "ZYX", True)], ";").replace(".", ","), "\r\n"),
        ("xyz+abc-deg", "mm", "order"),
    ),
    "json list": ("data.json", json.dumps(LIST[::-1]), ("matrix-4x4", "m", "name")),
    "links of which one is the flange": ("poses.json", json.dumps(LINKS), ("matrix-4x4", "m", "name")),
    "opencv yaml": (
        "robot.yml",
        "%YAML:1.0\n---\n"
        + of_each(
            lambda k, p: (
                f"pose{k}: !!opencv-matrix\n   rows: 3\n   cols: 4\n   dt: d\n   data: [ {row(p[:3], ', ')} ]\n"
            )
        ),
        ("matrix-4x4", "m", "name"),
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
        ("matrix-4x4", "m", "name"),
    ),
    "xml with a pose in an attribute": (
        "robot.xml",
        "<stops>" + of_each(lambda k, p: f"<pose_{k} value='{row([*p[:3, 3], *quaternion(p)])}'/>") + "</stops>",
        ("xyz+quaternion-xyzw", "m", "name"),
    ),
    "decimal commas apart by spaces": (
        "p.txt",
        of_each(lambda k, p: row([*p[:3, 3], *quaternion(p)]).replace(".", ",")),
        ("xyz+quaternion-xyzw", "m", "order"),
    ),
    "quoted decimal commas, minus signs of print": (
        "p.csv",
        of_each(lambda k, p: ",".join(f'"{v:.9f}"'.translate(PRINTED) for v in (*p[:3, 3], *quaternion(p)))),
        ("xyz+quaternion-xyzw", "m", "order"),
    ),
    "json with a number before": (
        "p.json",
        json.dumps([[k, *p[:3, 3], *angles(p)] for k, p in enumerate(POSES)]),
        ("xyz+rotvec-rad", "m", "order"),
    ),
    "counted from another number": (
        "p.txt",
        "n x y z qx qy qz qw\n" + of_each(lambda k, p: row([k + 2, *p[:3, 3], *quaternion(p)])),
        ("xyz+quaternion-xyzw", "m", "order"),
    ),
    "xml with joints beside": (
        "robot.xml",
        f"<stops>{of_each(joints_and_pose)}</stops>",
        ("xyz+rpy-rad", "mm", "name"),
    ),
    "times before rotation vectors": (
        "poses.txt",
        of_each(lambda k, p: row([1.7e9 + 3.7 * k, *p[:3, 3], *angles(p)])),
        ("xyz+rotvec-rad", "m", "order"),
    ),
    "titles above rotation and position": (
        "info.txt",
        of_each(lambda k, p: f"{k}:\nRotation:\n{angles(p).tolist()}\nTranslation:\n{p[:3, 3].tolist()}\n"),
        ("xyz+rotvec-rad", "m", "name"),
    ),
    "program of the arm": (
        "photographs.script",
        PROGRAM
        + of_each(lambda k, p: f"  movel(p[{row([*p[:3, 3], *angles(p)], ', ')}], a=1.2, v=0.25)\n  sleep(0.5)")
        + "\nend\n",
        ("xyz+rotvec-rad", "m", "order"),
    ),
    "as the arm's client records them": (
        "robot_data.csv",
        f"timestamp {NAMES}\n" + of_each(lambda k, p: row([100.0 + k, *JOINTS[k], *p[:3, 3], *angles(p)])),
        ("xyz+rotvec-rad", "m", "order"),
    ),
}


def write(folder: Path, spelling: str) -> None:
    name, text, _ = SPELLINGS[spelling]
    if isinstance(name, str):
        (folder / name).write_bytes(text.encode())
    else:
        name(folder)


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_poses_are_read_as_they_were_meant(recording, seen, spelling):
    write(recording, spelling)
    frames, understood, unread = understand(recording, seen)
    assert understood.notes == [], unread
    about = understood.about
    assert (about["reading"], about["unit"], about["matched_by"]) == SPELLINGS[spelling][2]
    assert about["setup"] == "eye_in_hand"
    assert about["turn_deg"] < 0.1 and about["shift_mm"] < 0.5
    for frame, pose in zip(frames, POSES, strict=True):
        assert np.abs(frame.base_from_flange.homogeneous - pose).max() < 1e-6


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


@pytest.mark.parametrize("word", [".nan", ".Nan", ".NAN", "-.Inf"])
def test_a_number_that_is_none_in_yaml_leaves_the_other_poses_whole(tmp_path, word):
    path = tmp_path / "poses.yaml"
    path.write_text(f"pose1: [0.1, 0.2, 0.3, 0, 0, 0, 1]\npose2: [0.1, {word}, 0.3, 0, 0, 0, 1]\n")
    first, second = read_content(path).records
    assert np.isfinite(first.numbers).all()
    assert np.isfinite(second.numbers).tolist() == [True, False, *[True] * 5]


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
