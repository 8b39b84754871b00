"""Frames are kept as they are, by a thread of its own; what cannot be written is told."""

import hashlib

import cv2
import numpy as np
import pytest

from cell.procedures.frame_store import FrameStore
from drivers.errors import CellError
from drivers.interfaces import Frame


def frame(number: int, image: np.ndarray | None = None) -> Frame:
    return Frame(np.zeros((4, 4), np.uint8) if image is None else image, number, 0.01, 0.0, 0.0, 0.0)


def test_a_frame_is_kept_to_the_last_bit_and_its_digest_is_that_of_its_file(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (48, 64)).astype(np.uint8)
    with FrameStore(tmp_path / "frames") as store:
        store.keep("stripe", frame(7, image))
        digests = store.settle()
    path = tmp_path / "frames" / "stripe-000007.png"
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), image)
    assert digests == {path.name: hashlib.sha256(path.read_bytes()).hexdigest()}


def test_of_a_frame_that_is_cut_the_file_holds_what_was_made_of_it(tmp_path):
    cut = np.zeros((48, 64), np.uint8)
    cut[:, 20:30] = 90
    with FrameStore(tmp_path / "frames") as store:
        store.keep("stripe", frame(7, np.full((48, 64), 90, np.uint8)), lambda: cut)
        store.settle()
    kept = cv2.imread(str(tmp_path / "frames" / "stripe-000007.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(kept, cut)


def test_where_no_frames_are_kept_the_last_one_is_still_known(tmp_path):
    with FrameStore(tmp_path / "frames", kept=False) as store:
        store.keep("stripe", frame(7))
        assert store.settle() == {}
        assert store.last is not None
        assert list(store.recent) == []
    assert not (tmp_path / "frames").exists()


def test_frames_that_cannot_be_written_are_told_at_the_next_one(tmp_path):
    (tmp_path / "frames").write_text("a file where the folder should be")
    with FrameStore(tmp_path / "frames") as store:
        store.keep("stripe", frame(1))
        with pytest.raises(CellError, match=r"frames cannot be kept: .*make room in"):
            store.settle()
        with pytest.raises(CellError, match="frames cannot be kept"):
            store.keep("stripe", frame(2))


def test_only_the_frames_of_the_last_step_are_its_evidence(tmp_path):
    with FrameStore(tmp_path / "frames") as store:
        store.keep("board-01", frame(1))
        store.begin()
        for number in range(2, 40):
            store.keep("stripe", frame(number))
    assert (store.recent[-1], len(store.recent)) == ("stripe-000039.png", 12)
    assert len(list((tmp_path / "frames").iterdir())) == 39
