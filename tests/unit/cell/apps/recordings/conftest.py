"""A recording of eight pictures, and the boards that were seen in them."""

from pathlib import Path

import cv2
import pytest

from cell.apps.recordings.frames import RecordedFrame, read_frames
from cell.apps.recordings.series import list_folder
from tests.unit.cell.apps.recordings.pictures import BOARD, POSES, photograph


@pytest.fixture(scope="session")
def pictures(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    for k, pose in enumerate(POSES):
        cv2.imwrite(str(folder / f"frame{k + 3:02d}.png"), photograph(pose))
    return folder


@pytest.fixture(scope="session")
def seen(pictures) -> dict[str, RecordedFrame]:
    frames, _ = read_frames(list_folder(pictures), BOARD)
    assert all(f.reason is None for f in frames), [f.text for f in frames]
    return {f.name: f for f in frames}


@pytest.fixture
def recording(tmp_path, pictures) -> Path:
    for path in pictures.iterdir():
        (tmp_path / path.name).symlink_to(path)
    return tmp_path
