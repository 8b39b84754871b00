"""The watch over a motion of the rail, and what a sweep tells, by readings that are written down here."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest

from drivers.clock import Clock
from drivers.errors import Aborted, CellError, DeadlineError, DeviceFault, InterlockError, NotConnectedError
from drivers.rail.motion import RailMotion
from drivers.rail.sweep import RailSweep

FAST = 100.0


def motion(arrived: Callable[[], bool], halts: list[str], duration: float = 1.0, least: float = 0.0) -> RailMotion:
    return RailMotion(
        "rail", Clock(FAST), arrived=arrived, halt=lambda: halts.append("halt"), duration=duration, least=least
    )


def raising(error: Exception) -> Callable[[], bool]:
    def arrived() -> bool:
        raise error

    return arrived


def test_a_motion_that_never_arrives_is_halted_and_told() -> None:
    halts: list[str] = []
    with pytest.raises(DeviceFault, match="has not ended after twice that") as caught:
        motion(lambda: False, halts).wait(500.0)
    assert caught.value.code == "rail.missed_target"
    assert halts == ["halt"]


@pytest.mark.parametrize(
    ("error", "told", "halted"),
    [
        (DeviceFault("rail", "rail.stalled", "stalled", recoverable=True, hint=""), DeviceFault, True),
        (DeadlineError("rail", "no reply"), DeadlineError, True),
        (ZeroDivisionError("unforeseen"), DeviceFault, True),
        (Aborted("stopped"), Aborted, False),
        (NotConnectedError("rail", "closed"), NotConnectedError, False),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)
def test_what_ends_a_motion_is_told_to_each_who_waits_and_it_is_halted_unless_it_was(
    error: Exception, told: type[CellError], halted: bool
) -> None:
    halts: list[str] = []
    moving = motion(raising(error), halts)
    for _ in range(2):
        with pytest.raises(told):
            moving.wait(5.0)
    assert moving.done
    assert halts == ["halt"] * halted


def test_who_does_not_wait_any_longer_has_it_halted() -> None:
    halts: list[str] = []
    there = threading.Event()
    moving = motion(there.is_set, halts, duration=100.0)
    with pytest.raises(DeadlineError, match="was stopped"):
        moving.wait(0.1)
    assert halts == ["halt"]
    there.set()
    moving.wait(50.0)


def test_a_motion_that_is_there_too_soon_went_faster_than_it_was_told() -> None:
    with pytest.raises(DeviceFault, match=r"at its speed it takes 1e\+04 s at least") as caught:
        motion(lambda: True, [], least=1e4).wait(500.0)
    assert caught.value.code == "rail.too_fast"
    motion(lambda: True, [], least=0.2).wait(500.0)  # too short to be judged


def sweep(
    *, start: float = 0.02, stop: float = 0.06, ran: float = 0.02, bend: float = 0.0, count: int = 41,
    arrived: Callable[[], bool] = lambda: True,
) -> RailSweep:  # fmt: skip
    """From 5 mm before `start` to 5 mm behind `stop`, told 20 mm/s; it ran at `ran`, `bend` m off half-way."""
    way = np.sign(stop - start)
    places = np.linspace(start - 0.005 * way, stop + 0.005 * way, count)
    seconds = np.abs(places - places[0]) / ran
    places = places + bend * np.sin(np.pi * np.arange(count) / (count - 1))
    record = [(100.0 + float(t), float(x), 1e-4) for t, x in zip(seconds, places, strict=True)]
    return RailSweep(
        "rail", Clock(FAST), start=start, stop=stop, speed=0.02, resolution=1e-6, record=record, arrived=arrived,
        halt=lambda: None, duration=1.0,
    )  # fmt: skip


@pytest.mark.parametrize(("start", "stop"), [(0.02, 0.06), (0.06, 0.02)])
def test_a_sweep_tells_its_place_inside_its_window_only(start: float, stop: float) -> None:
    made = sweep(start=start, stop=stop)
    made.wait(50.0)
    begin, end = made.window
    assert (begin, end) == pytest.approx((100.25, 102.25), abs=1e-6)
    assert made.position_at(101.25) == pytest.approx(0.04, abs=1e-8)
    assert made.position_at(begin) == pytest.approx(start, abs=1e-8)
    for outside in (begin - 1e-3, end + 1e-3):
        with pytest.raises(ValueError, match="outside the sweep's constant-velocity window"):
            made.position_at(outside)


def test_a_sweep_tells_nothing_before_its_end_nor_after_a_failed_one() -> None:
    there = threading.Event()
    made = sweep(arrived=there.is_set)
    for asked in (lambda: made.window, lambda: made.position_at(101.0), lambda: made.time_bound):
        with pytest.raises(InterlockError, match="still runs"):
            asked()
    there.set()
    made.wait(50.0)
    assert made.window
    failed = sweep(arrived=raising(DeviceFault("rail", "rail.stalled", "stalled", recoverable=True, hint="")))
    failed.join(2.0)
    with pytest.raises(DeviceFault, match="stalled"):
        _ = failed.window


@pytest.mark.parametrize(
    ("made", "code"),
    [
        ({"ran": 0.0188}, "rail.velocity"),
        ({"ran": 0.0212}, "rail.velocity"),
        ({"count": 4}, "rail.velocity"),
        ({"bend": 0.5e-3}, "rail.uneven"),
        ({"bend": -0.5e-3}, "rail.uneven"),
    ],
    ids=str,
)
def test_a_sweep_that_was_not_as_commanded_has_no_window(made: dict[str, float], code: str) -> None:
    ended = sweep(**made)  # type: ignore[arg-type]
    ended.wait(50.0)
    with pytest.raises(DeviceFault) as caught:
        _ = ended.window
    assert caught.value.code == code


@pytest.mark.parametrize("ran", [0.0192, 0.0208])
def test_a_velocity_within_what_is_allowed_is_the_one_that_was_measured(ran: float) -> None:
    ended = sweep(ran=ran)
    ended.wait(50.0)
    begin, end = ended.window
    assert end - begin == pytest.approx(0.04 / ran, rel=1e-6)
