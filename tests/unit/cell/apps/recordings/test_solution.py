"""Promises on the camera of recorded pictures: pictures that are of another are named, what it is off by is stated."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cell.apps.recordings.solution import camera_of
from cell.measure.calibration.judge.faults import foreign_view, own_cameras
from cell.measure.calibration.solve.intrinsics import choose_lens
from drivers.errors import RefusedError
from tests.support.recorded_scenes import LENS, MATRIX, Z, scene


@pytest.mark.parametrize(("focal", "count"), [(1.05, 8), pytest.param(1.3, 7, marks=pytest.mark.campaign), (0.7, 6)])
def test_one_picture_of_another_camera_of_the_same_size_is_refused_by_name(focal, count):
    """Its own pose hides most of it: it moved the focal length by 120 px, and was a doubt or none."""
    frames = scene(seed=3, count=count, laser=False)
    frames[2] = scene(seed=3, count=count, laser=False, focal=focal)[2]
    camera = camera_of(frames)[0]
    assert [f.name for f in frames if f.reason is not None] == [frames[2].name]
    assert "taken by another camera" in frames[2].text or "another board" in frames[2].text
    assert abs(camera.camera.fx - MATRIX[0, 0]) < Z * camera.sigma[0] < 0.02 * MATRIX[0, 0]


@pytest.mark.parametrize("bend", [0.0, 2e-3])
def test_no_picture_is_foreign_where_nothing_or_the_board_is_wrong(bend):
    """A bent board wants another camera in every picture: F goes to 50, and nobody is to blame."""
    frames = scene(seed=1, count=8, laser=False, bend=bend)
    views = [frame.view for frame in frames]
    found, _ = choose_lens(views)
    assert (own_cameras(found, views).max() < 4.0) == (bend == 0.0)
    assert foreign_view(found, views) is None


def test_a_zoom_that_was_changed_in_the_middle_gives_no_hand_eye():
    """Half of the frames agree with themselves, and so do the others: both cameras are told, and neither is taken."""
    frames = [*scene(count=9, laser=False)[:4], *scene(count=9, laser=False, focal=1.03)[4:]]
    words = r"up to frame000[234].png give fx = 1[34]\d\d .* zoom, focus or camera were"
    with pytest.raises(RefusedError, match=words):
        camera_of(frames)


@pytest.mark.parametrize("seed", [4, 5])
def test_views_from_one_side_are_no_change_of_zoom(seed):
    """The first three look square on at a bent board and take the bend for another focal length, 821 ± 21 px."""
    rng = np.random.default_rng(seed)
    frames = scene(seed=seed, count=9, laser=False)
    real = frames[0].view.object_points - frames[0].view.object_points.mean(axis=0)
    real[:, 2] += 5e-4 * (real[:, 0] / np.abs(real[:, 0]).max()) ** 2
    for frame, tilt in zip(frames, np.radians([1, 1, 2, 25, 25, 25, 25, 25, 25]), strict=True):
        way = rng.uniform(0, 2 * np.pi)
        at = np.array([*rng.uniform(-0.03, 0.03, 2), 0.4 + rng.uniform(-0.03, 0.03)])
        pixels = cv2.projectPoints(real, tilt * np.array([np.cos(way), np.sin(way), 0.0]), at, MATRIX, LENS)[0]
        pixels = pixels.reshape(-1, 2)
        frame.view = replace(frame.view, pixels=pixels + rng.normal(0, 0.05, pixels.shape))
    found, _ = camera_of(frames)
    assert abs(found.camera.fx - MATRIX[0, 0]) < Z * found.sigma[0] < 0.1 * MATRIX[0, 0]


def test_a_picture_whose_pose_cannot_be_told_does_not_take_the_camera_of_the_others():
    frames = scene(seed=1, count=7, laser=False)
    view = frames[3].view
    far = np.array([1.2, 0.0, 0.0]), np.array([0.0, 0.0, 9.0])
    points = view.object_points - view.object_points.mean(axis=0)
    frames[3].view = replace(view, pixels=cv2.projectPoints(points, *far, MATRIX, LENS)[0].reshape(-1, 2))
    found, _ = camera_of(frames)
    assert [f.name for f in frames if f.reason is not None] == [frames[3].name]
    assert "two poses" in frames[3].text
    assert abs(found.camera.fx - MATRIX[0, 0]) < Z * found.sigma[0]
