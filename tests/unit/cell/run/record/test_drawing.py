"""What is drawn of a job: frames, lenses, pictures, bodies and points tell one story."""

import subprocess
import sys
from collections import defaultdict
from operator import itemgetter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cell.measure.reconstruction.ply import read_cloud
from lab.bench.job.whole_job import JobRecord
from tests.unit.cell.run.record.conftest import Messages


def test_frames_lead_from_the_root_to_where_the_arm_itself_says_that_its_flange_is(read: Messages):
    """The arm computes its flange from its own table; the chain is the joints' through the product's kinematics."""
    chains = [(stamp, {t.child_frame_id: t for t in message.transforms}) for stamp, message in read["/tf"]]
    arms = {stamp: chain for stamp, chain in chains if "flange" in chain}
    checked = 0
    for stamp, state in read["/arm/state"]:
        pose = followed(arms[stamp], "flange", "tf#/")
        told = np.array(state["flange"])
        assert np.allclose(pose[:3, 3], told[:3], atol=1e-7)
        assert np.allclose(pose[:3, :3], Rotation.from_rotvec(told[3:]).as_matrix(), atol=1e-7)
        checked += 1
    assert checked > 100
    root = chains[0][1]["base"]
    assert root.parent_frame_id == "tf#/" and np.array_equal(matrix(root), np.eye(4))


def matrix(transform: Any) -> np.ndarray[Any, Any]:
    made = np.eye(4)
    q, t = transform.rotation, transform.translation
    made[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    made[:3, 3] = t.x, t.y, t.z
    return made


def test_pictures_are_the_files_and_carry_the_lens_they_were_taken_with(
    read: Messages, folder: Path, placed_pot: JobRecord
):
    lenses = {"scan_camera": placed_pot.calibration.scan.camera, "target_camera": placed_pot.calibration.target.camera}
    kept = {path.name for path in (folder / "frames").iterdir()}
    for name, camera in lenses.items():
        told, images = read[f"/{name}/frame"], read[f"/{name}/image"]
        assert len(told) == len(read[f"/{name}/calibration"])
        kept -= {frame["file"] for _, frame in told}
        files = {stamp: frame["file"] for stamp, frame in told}
        for at, image in images:
            assert (image.frame_id, image.format) == (name, "png")
            assert image.data == (folder / "frames" / files[at]).read_bytes()
        shown = np.array([at for at, _ in images])
        assert np.diff(shown).min() >= 0.5e9 and max(np.abs(shown - at).min() for at in files) < 0.5e9
        _, lens = read[f"/{name}/calibration"][0]
        points = np.array([[0.01, -0.02, 0.2], [0.0, 0.0, 1.0], [0.03, 0.01, 0.3]])
        # By OpenCV, whose model "plumb_bob" is.
        seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.array(lens.K).reshape(3, 3), np.array(lens.D))
        assert np.allclose(seen[:, 0], camera.project(points), atol=1e-6)
    assert not kept


def test_the_lines_and_all_of_them_are_the_cloud_of_the_run(read: Messages, folder: Path):
    stored = read_cloud(folder / "cloud.ply")
    measured = stored.points[~stored.interpolated].astype("<f4")
    told = sorted(read["/cloud/line"], key=itemgetter(0))
    lines = [np.frombuffer(message.data, "<f4").reshape(-1, 3) for _, message in told]
    assert np.array_equal(np.concatenate(lines), measured)
    [(_, whole)] = read["/cloud/whole"]
    assert np.array_equal(np.frombuffer(whole.data, "<f4").reshape(-1, 3), measured)


def test_the_clouds_points_lie_on_the_stripe_of_the_picture_taken_then(read: Messages):
    """Frames, lens, picture and cloud tell one story: by OpenCV's projection and the bright line in the picture."""
    poses, chain = [], {}
    for stamp, message in sorted(read["/tf"], key=itemgetter(0)):
        chain |= {t.child_frame_id: t for t in message.transforms}
        if "flange" in chain and any(t.child_frame_id == "scan_camera" for t in message.transforms):
            poses.append((stamp, followed(chain, "scan_camera", "base")))
    pictures = dict(read["/scan_camera/image"])
    lens = read["/scan_camera/calibration"][0][1]
    lines = read["/cloud/line"]
    swept = sorted(at for at in pictures if lines[0][0] < at < lines[-1][0])
    for at in (swept[len(swept) // 4], swept[len(swept) // 2], swept[3 * len(swept) // 4]):
        line = min(lines, key=lambda other: abs(other[0] - at))[1]
        image = cv2.imdecode(np.frombuffer(pictures[at].data, np.uint8), cv2.IMREAD_GRAYSCALE)
        k = next(k for k, (other, _) in enumerate(poses) if other > at)
        (before, earlier), (after, later) = poses[k - 1 : k + 1]
        share = (at - before) / (after - before)
        pose = (1 - share) * earlier + share * later
        points = np.frombuffer(line.data, "<f4").reshape(-1, 3).astype(float)
        seen = (points - pose[:3, 3]) @ pose[:3, :3]
        pixels, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), np.array(lens.K).reshape(3, 3), np.array(lens.D))
        columns, rows = np.rint(pixels[:, 0]).astype(int).T
        inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1] - 8)
        assert np.count_nonzero(inside) > 0.98 * len(points)
        columns, rows = columns[inside], rows[inside]
        brightness = image[rows, columns]
        assert np.median(brightness) > 5 * max(1.0, float(np.median(image)))
        # Half a millimetre beside it there is none.
        assert np.median(image[rows, columns + 8]) < 0.5 * np.median(brightness)


def followed(chain: dict[str, Any], name: str, root: str) -> np.ndarray[Any, Any]:
    """root_from_name."""
    pose = np.eye(4)
    while name != root:
        pose, name = matrix(chain[name]) @ pose, chain[name].parent_frame_id
    return pose


def test_bodies_stand_in_frames_that_are_told_and_the_part_changes_hands(read: Messages):
    frames = {"base", *(t.child_frame_id for _, message in read["/tf"] for t in message.transforms)}
    there: dict[str, str] = {}
    history = []
    for _, update in read["/scene"]:
        for entity in update.entities:
            assert entity.frame_id in frames
            assert entity.cubes or entity.cylinders
            there[entity.id] = entity.frame_id
        for deletion in update.deletions:
            del there[deletion.id]
        history.append({name: there.get(name) for name in ("part", "placed part", "surface")})
    assert {"part": "flange", "placed part": None, "surface": "base"} in history
    assert history[-1] == {"part": None, "placed part": "base", "surface": "base"}


def test_rerun_sees_frames_lenses_pictures_and_cloud(folder: Path, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    command = Path(sys.executable).with_name("rerun")
    out = tmp_path / "record.rrd"
    convert = [command, "mcap", "convert", folder / "record.mcap", "-o", out]
    subprocess.run(convert, check=True, capture_output=True, timeout=120)
    told = subprocess.run([command, "rrd", "print", out], check=True, capture_output=True, text=True, timeout=120)
    found: dict[str, str] = defaultdict(str)
    for line in (told.stdout + told.stderr).splitlines():
        if " - /" in line:
            found[line.split(" - ")[1].strip()] += line
    assert "Transform3D:parent_frame" in found["/tf"]
    assert "Points3D:positions" in found["/cloud/line"] and "Points3D:positions" in found["/cloud/whole"]
    for camera in ("scan_camera", "target_camera"):
        assert "EncodedImage:blob" in found[f"/{camera}/image"]
        assert "Pinhole:image_from_camera" in found[f"/{camera}/calibration"]
    assert "TextLog:text" in found["/log"]
