"""Frames between the thread that receives them and the one that uses them: which are lost, stale, or too many."""

import math
import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.devices.simulated.direct import VirtualCell
from drivers.camera.frame_queue import FrameQueue
from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError, DeviceFault
from drivers.interfaces import Frame, LinkStatistics


def frame(number: int) -> Frame:
    return Frame(np.zeros((1, 1), np.uint8), number, 0.01, 0.02 * number, 0.02 * number, 1.0 + 0.02 * number)


def queue(capacity: int = 8, check: Callable[[], None] = lambda: None, exposure: float | None = None) -> FrameQueue:
    return FrameQueue(
        "camera", Clock(), capacity=capacity, longest_gap=0.1, check=check, statistics=LinkStatistics(),
        exposure=exposure,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("wrong", "code", "told"),
    [
        ({"device_time": math.nan}, "camera.stamp", "time stamp of frame 3 is nan s"),
        ({"host_time": math.inf}, "camera.stamp", "time stamp of frame 3 is"),
        ({"exposure": math.nan}, "camera.exposure", "says it was exposed nan s"),
        ({"exposure": -0.01}, "camera.exposure", "says it was exposed -0.01 s"),
        ({"exposure": 0.002}, "camera.exposure", "exposed 2.00 ms instead of 10.00 ms: it belongs to another setting"),
        ({"device_time": 0.03}, "camera.stamp", "goes back by 10.0 ms from that of frame 2"),
        ({"device_time": 0.04}, "camera.stamp", "goes back by -?0.0 ms"),
        ({"device_time": 0.044}, "camera.stamp", "4.00 ms after .* frame 2, .* it belongs to another exposure"),
        ({"host_time": 2.0}, "camera.stamp", "in the future: its exposure ends 950.0 ms after the picture came"),
    ],
)
def test_a_frame_whose_times_cannot_be_true_ends_the_acquisition(wrong: dict[str, float], code: str, told: str):
    """Those before it are handed out; after it none is."""
    frames = queue(exposure=0.01)
    frames.expect(1)
    for made in (frame(0), frame(1), frame(2), replace(frame(3), **wrong), frame(4)):
        frames.put(made)
    assert [frames.next(0.1).frame_id for _ in range(2)] == [1, 2]
    for _ in range(2):
        with pytest.raises(DeviceFault, match=told) as met:
            frames.next(0.1)
        assert (met.value.code, met.value.recoverable) == (code, False)


@pytest.mark.parametrize(
    ("first", "come", "handed_out", "lost_before"),
    [
        (10, (12, 13, 17), [12, 13, 17], [2, 0, 3]),
        (None, (12,), [12], [0]),
        # Those of before are never handed out, nor one that comes a second time, or out of its turn.
        (10, (9, 10, 10, 9, 11), [10, 11], [0, 0]),
    ],
)
def test_each_gap_in_the_numbers_is_lost_frames_the_first_one_too_if_its_number_is_told(
    first: int | None, come: tuple[int, ...], handed_out: list[int], lost_before: list[int]
):
    frames = queue()
    frames.expect(first)
    for number in come:
        frames.put(frame(number))
    taken = [frames.next(0.1) for _ in handed_out]
    assert [one.frame_id for one in taken] == handed_out
    assert [one.lost_before for one in taken] == lost_before
    with pytest.raises(DeadlineError, match="no frame within"):
        frames.next(0.01)
    assert frames.lost == sum(lost_before)


def test_frames_that_find_it_full_are_lost_and_the_earlier_ones_kept():
    frames = queue(capacity=2)
    frames.expect(1)
    for number in (1, 2, 3, 4):
        frames.put(frame(number))
    assert [frames.next(0.1).frame_id for _ in range(2)] == [1, 2]
    frames.put(frame(5))
    assert (frames.next(0.1).lost_before, frames.lost) == (2, 2)


@pytest.mark.parametrize("aborted", [True, False])
def test_an_end_that_was_asked_for_ends_who_iterates_and_a_stop_is_told(aborted: bool):
    frames = queue()
    frames.put(frame(1))
    taken: list[int] = []

    def take() -> None:
        for one in frames:
            taken.append(one.frame_id)
            frames.put(frame(2))
            frames.close(aborted=aborted)

    if aborted:
        with pytest.raises(Aborted):
            take()
    else:
        take()
    assert taken == [1], "what was waiting is not handed out any more"
    with pytest.raises(Aborted):
        frames.next(0.1)


def test_a_simulated_camera_that_is_stopped_while_a_frame_is_looked_at_says_so_as_well():
    camera = VirtualCell(load_config(None), seed=4, level="ideal").scan_camera
    camera.configure(0.005, 10.0)
    with camera.stream() as frames, pytest.raises(Aborted):
        for _ in frames:
            camera.stop()


def test_who_waits_is_told_at_once_that_none_can_come():
    broken = threading.Event()

    def check() -> None:
        if broken.is_set():
            raise DeviceFault("camera", "camera.lost", "gone", recoverable=True, hint="")

    frames = queue(check=check)

    def end() -> None:
        broken.set()
        frames.wake()

    threading.Timer(0.02, end).start()
    with pytest.raises(DeviceFault, match="gone"):
        frames.next(5.0)
