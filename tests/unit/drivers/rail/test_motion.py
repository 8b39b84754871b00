"""The watch over a motion of the rail, and what a sweep tells, by readings that are written down here."""

import threading
from collections.abc import Callable

import numpy as np
import pytest

from drivers.clock import Clock
from drivers.errors import Aborted, CellError, DeadlineError, DeviceFault, InterlockError, NotConnectedError
from drivers.rail.motion import RailMotion, Stops, move_duration, run_up_distance
from tests.support.wire.rail_bench import Bench, benched, connect

FAST = 100.0


def motion(arrived: Callable[[], bool], halts: list[str], duration: float = 1.0, least: float = 0.0) -> RailMotion:
    return RailMotion(
        "rail", Clock(FAST), arrived=arrived, halt=lambda: halts.append("halt"), duration=duration, least=least
    )


def raising(error: Exception) -> Callable[[], bool]:
    def arrived() -> bool:
        raise error

    return arrived


def test_a_motion_that_never_arrives_is_halted_and_told():
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
):
    halts: list[str] = []
    moving = motion(raising(error), halts)
    for _ in range(2):
        with pytest.raises(told):
            moving.wait(5.0)
    assert moving.done
    assert halts == ["halt"] * halted


def test_who_does_not_wait_any_longer_has_it_halted():
    halts: list[str] = []
    there = threading.Event()
    moving = motion(there.is_set, halts, duration=100.0)
    with pytest.raises(DeadlineError, match="was stopped"):
        moving.wait(0.1)
    assert halts == ["halt"]
    there.set()
    moving.wait(50.0)


def test_a_motion_that_is_there_too_soon_went_faster_than_it_was_told():
    with pytest.raises(DeviceFault, match=r"at its speed it takes 1e\+04 s at least") as caught:
        motion(lambda: True, [], least=1e4).wait(500.0)
    assert caught.value.code == "rail.too_fast"
    motion(lambda: True, [], least=0.2).wait(500.0)  # too short to be judged


def test_ramps_follow_from_speed_and_acceleration():
    assert run_up_distance(0.2, 0.5) == pytest.approx(0.04)
    assert move_duration(0.2, 0.2, 0.5) == pytest.approx(2 * 0.4 + (0.2 - 0.08) / 0.2)
    assert move_duration(-0.02, 0.2, 0.5) == pytest.approx(2 * np.sqrt(0.02 / 0.5))


@pytest.mark.wire
@pytest.mark.parametrize(("lost", "refused"), [(0.03e-3, False), (0.09e-3, True), (-0.09e-3, True)])
def test_a_count_that_is_off_by_more_than_a_twentieth_of_a_millimetre_is_refused(lost: float, refused: bool):
    with benched(4.0) as made:
        rail, model = made.rail, made.model
        rail.home().wait(20.0)
        counted = model.position(made.world.now())
        model.set_position(made.world.now(), counted + round(lost * 200 * 256 / 0.002))
        check = rail.check_zero()
        assert check is not None
        if refused:
            with pytest.raises(DeviceFault, match=r"lost steps .* between .* by its count \(allowed 0 ± 0.05 mm\)"):
                check.wait(10.0)
            with pytest.raises(InterlockError, match="not homed"):
                rail.sweep(0.01, 0.09, 0.02)
        else:
            check.wait(10.0)
            assert rail.state().homed and abs(rail.state().position) < 1e-5
        rail.close()
        limited = connect(made.peer.url, made.clock, reference_mode=1)
        assert limited.check_zero() is None
        limited.close()


def test_a_stopped_motion_ends_as_its_stop_did():
    stops = Stops()
    with stops.one_more():
        assert not stops.end("rail", 0.005), "nobody knows yet"
    with pytest.raises(Aborted, match="stopped at 5 mm before its target"):
        stops.end("rail", 0.005)
    with pytest.raises(Aborted, match="stopped while it searched the reference switch"):
        stops.end("rail")
    with pytest.raises(DeadlineError), stops.one_more():
        raise DeadlineError("rail", "no answer")
    with pytest.raises(DeviceFault, match="has not confirmed it; at 5 mm it may go on") as told:
        stops.end("rail", 0.005)
    assert (told.value.code, stops.count) == ("rail.not_stopped", 2)


@pytest.mark.wire
@pytest.mark.parametrize(("begin", "way"), [("move_to", 0.09), ("nudge", 0.01)])
def test_a_start_whose_answer_was_lost_is_stopped(homed: Bench, begin: str, way: float, monkeypatch):
    """The drive may have taken it, and nobody would watch that motion."""
    send = homed.rail._send

    def lost(*words: object) -> None:
        send(*words)  # type: ignore[arg-type]
        raise DeadlineError("rail", "no answer")

    monkeypatch.setattr(homed.rail, "_send", lost)
    with pytest.raises(DeadlineError, match="no answer"):
        getattr(homed.rail, begin)(way, 0.01)
    homed.clock.sleep(0.3)
    before = homed.carriage()
    homed.clock.sleep(0.5)
    assert homed.carriage() == pytest.approx(before, abs=1e-6)
    assert before < 0.8 * way
