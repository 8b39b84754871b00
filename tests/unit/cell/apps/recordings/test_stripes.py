"""Promises on the laser in colour pictures, and on pictures without it."""

import cv2
import numpy as np

from cell.apps.recordings.frames import read_frames
from cell.apps.recordings.series import list_folder
from cell.measure.vision.stripe.planes import LaserChannel
from tests.unit.cell.apps.recordings.pictures import BOARD, lit


def test_a_red_laser_on_white_paper_is_read_in_colour_and_never_wrongly_in_grey(tmp_path, pictures):
    path = min(pictures.iterdir())
    cv2.imwrite(str(tmp_path / path.name), lit(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) * 0.8, 60))
    frames, channel = read_frames(list_folder(tmp_path), BOARD)
    assert channel.chosen is not LaserChannel.GREY
    assert sum(channel.votes.values()) == 1
    (frame,) = frames
    rows = frame.profile.rows
    assert np.median(np.abs(frame.profile.centres[rows] - (300 + 0.1 * rows))) < 0.3
    (frame,), _ = read_frames(list_folder(tmp_path), BOARD, laser=LaserChannel.GREY)
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
