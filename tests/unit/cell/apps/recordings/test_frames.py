"""Promises on pictures that belong together: copies, what was drawn into, and a second one with the laser."""

import cv2
import numpy as np
import pytest

from cell.apps.recordings import frames as recorded_frames
from cell.apps.recordings.frames import read_frames
from cell.apps.recordings.series import list_folder
from cell.measure.vision.pictures import read_picture
from cell.measure.vision.stripe.planes import read_colours
from tests.unit.cell.apps.recordings.pictures import BASE_FROM_BOARD, BOARD, CAMERA, FLANGE_FROM_CAMERA, POSES, lit


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


@pytest.mark.parametrize("kind", [".png", ".jpg", ".tif"])
@pytest.mark.parametrize("draw", [drawn_corners, drawn_axes, drawn_circles])
def test_pictures_that_a_program_drew_into_are_set_aside_by_their_pixels(tmp_path, pictures, seen, draw, kind):
    """The names say nothing, and one that misleads: a view of its own is called corners. The .tif has 12 bits in 16."""
    for name, target in (("frame03.png", "corners.png"), ("frame04.png", "b.png"), ("frame05.png", "c.png")):
        (tmp_path / target).symlink_to(pictures / name)
    image = draw(
        cv2.cvtColor(cv2.imread(str(pictures / "frame04.png"), 0), cv2.COLOR_GRAY2BGR), seen["frame04.png"].view
    )
    cv2.imwrite(str(tmp_path / f"a{kind}"), image.astype(np.uint16) * 16 if kind == ".tif" else image)
    frames, _ = read_frames(list_folder(tmp_path), BOARD, laser=None)
    assert {f.name: f.text for f in frames if f.reason is not None} == {
        f"a{kind}": "it is b.png with lines drawn into it"
    }


def test_a_straightened_copy_is_no_view_of_its_own(tmp_path, pictures):
    for name in ("frame03", "frame04"):
        image = cv2.imread(str(pictures / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
        focal = np.array([[1500.0, 0, image.shape[1] / 2], [0, 1500.0, image.shape[0] / 2], [0, 0, 1]])
        cv2.imwrite(str(tmp_path / f"{name}_undistorted.png"), cv2.undistort(image, focal, np.array([-0.05, 0, 0, 0])))
    frames, _ = read_frames(list_folder(tmp_path), BOARD, laser=None)
    assert {f.name: f.text for f in frames if f.reason is not None} == {
        f"{name}_undistorted.png": f"by its name it is {name}.png, straightened" for name in ("frame03", "frame04")
    }


def test_pictures_without_colour_are_not_compared_in_full(tmp_path, pictures, monkeypatch):
    """Dark ones look alike when small; to compare each two of them took most of a plan's time."""
    image = cv2.imread(str(pictures / "frame04.png"), cv2.IMREAD_GRAYSCALE)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.roll(image // 2, 3 * k, axis=1))
    monkeypatch.setattr(recorded_frames, "_drawn_into", lambda *_: pytest.fail("compared in full"))
    frames, _ = read_frames(list_folder(tmp_path), BOARD, laser=None)
    assert [f.reason for f in frames] == [None] * 3


def test_a_picture_with_the_laser_is_not_taken_for_one_that_was_drawn_into(tmp_path, pictures):
    image = cv2.imread(str(pictures / "frame04.png"), cv2.IMREAD_GRAYSCALE) * 0.8
    cv2.imwrite(str(tmp_path / "a.png"), image)
    cv2.imwrite(str(tmp_path / "b.png"), lit(image, 200))
    frames, _ = read_frames(list_folder(tmp_path), BOARD)
    assert [(f.name, f.reason and f.reason.value) for f in frames] == [("a.png", None), ("b.png", "laser_picture")]


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
