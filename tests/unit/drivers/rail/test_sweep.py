"""What round trips tell of a rail's place in time: never less than the truth, as much as the shortest ones allow."""

import re
import threading
from collections.abc import Callable

import numpy as np
import pytest

from drivers.clock import Clock
from drivers.errors import DeviceFault, InterlockError
from drivers.interfaces import Vector
from drivers.rail.motion import run_up_distance
from drivers.rail.sweep import EvenMotion, RailSweep, fit_line
from tests.support.wire.rail_bench import ACCELERATION, Bench

SPEED = 0.015
DURATION = 4.0


def readings(n: int, late: float, share: float, seed: int, speed: float = SPEED) -> tuple[Vector, Vector, Vector]:
    """Readings of a motion that is at 0 m at time 0 s: times, positions, round trips. Ways to and fro take up to 0.4 ms
    each; of a `share` of the replies the way back takes `late` s more."""
    rng = np.random.default_rng(seed)
    asked = np.linspace(0.0, DURATION, n)
    held = asked + rng.uniform(0.0, 0.0004, n)
    answered = held + rng.uniform(0.0, 0.0004, n) + late * (rng.random(n) < share)
    return 0.5 * (asked + answered), speed * held, answered - asked


def errors(line: EvenMotion, speed: float = SPEED) -> Vector:
    """By how many seconds the line is off in the stretch that was read."""
    times = np.linspace(0.1, 0.9, 9) * DURATION
    return np.asarray((line.origin + line.velocity * times) / speed - times)


@pytest.mark.parametrize("speed", [SPEED, -SPEED])
@pytest.mark.parametrize("seed", range(20))
def test_the_bound_holds_and_is_a_fraction_of_a_round_trip(seed: int, speed: float):
    line = EvenMotion.of(*readings(300, 0.0, 0.0, seed, speed))
    assert np.abs(errors(line, speed)).max() <= line.time_bound * (1 + 1e-6)
    assert line.time_bound < 0.00008


@pytest.mark.parametrize("late", [0.02, 0.2])
@pytest.mark.parametrize("n", [7, 60, 300])
def test_replies_that_are_all_late_are_known_as_an_unknown_of_half_of_it(n: int, late: float):
    line = EvenMotion.of(*readings(n, late, 1.0, n))
    # The trap: the readings lie on a perfect line, half of the lateness off.
    assert errors(line).mean() == pytest.approx(-late / 2, abs=0.0004)
    assert np.abs(errors(line)).max() <= line.time_bound * (1 + 1e-3)
    assert line.time_bound == pytest.approx(late / 2, abs=0.0005)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_as_long_as_some_replies_are_prompt_they_tell_the_time(share: float):
    line = EvenMotion.of(*readings(300, 0.2, share, 5))
    assert np.abs(errors(line)).max() < 0.0002
    assert line.time_bound < 0.002


def test_readings_that_contradict_an_even_motion_say_so_and_late_ones_do_not():
    times, positions, trips = readings(300, 0.0, 0.0, 1)
    stepped = EvenMotion.of(times, positions + np.where(times > 2.0, 0.0005, 0.0), trips)
    assert stepped.unevenness > 0.00003
    for share in (0.0, 0.3, 0.6, 1.0):
        assert EvenMotion.of(*readings(300, 0.2, share, 2)).unevenness < 1e-9


@pytest.mark.parametrize("speed", [SPEED, -SPEED])
@pytest.mark.parametrize("late", [0.0, 0.02])
def test_what_no_even_motion_explains_is_found_beside_prompt_and_late_replies(speed: float, late: float):
    """A parabola is off the best line by an eighth of its rise, at most; one that round trips explain is not off."""
    times, positions, trips = readings(300, late, 0.5, 3, speed)
    assert EvenMotion.of(times, positions, trips).residual == 0.0
    held = positions / speed
    bend = 0.002 * np.square(held / DURATION) * np.sign(speed)
    bent = EvenMotion.of(times, positions + bend, trips)
    assert 0.002 / 8 - SPEED * 0.0012 <= bent.residual <= 0.002 / 8
    slight = EvenMotion.of(times, positions + 1e-3 * bend, trips)
    assert slight.residual <= 1e-6


def test_one_late_sample_does_not_bend_the_line():
    times = np.linspace(10.0, 12.0, 40)
    positions = 0.01 + 0.02 * (times - 10.0)
    trips = np.full(40, 0.001)
    times[30] += 0.25
    trips[30] = 0.5
    origin, velocity = fit_line(times, positions, trips)
    assert velocity == pytest.approx(0.02, rel=1e-4)
    assert origin + velocity * 11.0 == pytest.approx(0.03, abs=1e-6)


@pytest.mark.wire
@pytest.mark.parametrize(("start", "stop"), [(0.02, 0.06), (0.06, 0.02)])
def test_a_sweep_knows_its_position_at_any_time_to_some_micrometres(homed: Bench, start: float, stop: float):
    speed = 0.04
    homed.rail.move_to(homed.rail.sweep_start(start, stop, speed)).wait(10.0)
    sweep = homed.rail.sweep(start, stop, speed)
    with pytest.raises(InterlockError, match="still runs"):
        sweep.position_at(homed.clock.now())
    sweep.wait(10.0)
    begin, end = sweep.window
    assert end - begin == pytest.approx(abs(stop - start) / speed, rel=1e-3)
    times = np.linspace(begin, end, 50)[1:-1]
    errors = [sweep.position_at(time) - homed.carriage(time) for time in times]
    assert np.max(np.abs(errors)) < 30e-6
    assert speed * sweep.time_bound < 300e-6
    assert len(sweep.samples) > 20
    assert sweep.samples.shape[1] == 2
    with pytest.raises(ValueError, match="outside the sweep"):
        sweep.position_at(end + 0.1)
    # Outside of start and stop there is room for the ramps, and the rail has come to rest behind them.
    assert abs(homed.carriage() - stop) > run_up_distance(speed, ACCELERATION)


@pytest.mark.wire
def test_late_replies_shift_a_sweep_within_the_bound_that_it_states(homed: Bench):
    start, stop, speed = 0.02, 0.06, 0.005
    homed.rail.move_to(homed.rail.sweep_start(start, stop, speed)).wait(10.0)
    homed.peer.fault("rail.late_reply")
    sweep = homed.rail.sweep(start, stop, speed)
    sweep.wait(30.0)
    begin, end = sweep.window
    times = np.linspace(begin, end, 50)[5:-5]
    late = np.array([homed.carriage(time) - sweep.position_at(time) for time in times]) / speed
    # 0.2 s on the wall, half of which the middle of the round trip is off; and nothing but the round trips shows it.
    assert late.mean() == pytest.approx(0.1 * homed.clock.rate, rel=0.1)
    assert sweep.time_bound == pytest.approx(0.1 * homed.clock.rate, rel=0.1)
    # The bench's two clocks are compared to a millisecond only.
    assert late.max() <= sweep.time_bound + 0.005
    assert sweep.unevenness == 0.0


FAST = 100.0


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
def test_a_sweep_tells_its_place_inside_its_window_only(start: float, stop: float):
    made = sweep(start=start, stop=stop)
    made.wait(50.0)
    begin, end = made.window
    assert (begin, end) == pytest.approx((100.25, 102.25), abs=1e-6)
    assert made.position_at(101.25) == pytest.approx(0.04, abs=1e-8)
    assert made.position_at(begin) == pytest.approx(start, abs=1e-8)
    for outside in (begin - 1e-3, end + 1e-3):
        with pytest.raises(ValueError, match="outside the sweep's constant-velocity window"):
            made.position_at(outside)


def test_a_sweep_tells_nothing_before_its_end_nor_after_a_failed_one():
    there = threading.Event()
    made = sweep(arrived=there.is_set)
    for asked in (lambda: made.window, lambda: made.position_at(101.0), lambda: made.time_bound):
        with pytest.raises(InterlockError, match="still runs"):
            asked()
    there.set()
    made.wait(50.0)
    assert made.window

    def stalls() -> bool:
        raise DeviceFault("rail", "rail.stalled", "stalled", recoverable=True, hint="")

    failed = sweep(arrived=stalls)
    failed.join(2.0)
    with pytest.raises(DeviceFault, match="stalled"):
        _ = failed.window


@pytest.mark.parametrize(
    ("made", "told"),
    [
        ({"ran": 0.0188}, r"rail\.velocity: .*ran at 18\.800 mm/s instead of 20\.000 mm/s"),
        ({"ran": 0.0212}, r"rail\.velocity: .*ran at 21\.200 mm/s instead of 20\.000 mm/s"),
        ({"count": 4}, r"rail\.velocity"),
        ({"bend": 0.5e-3}, r"rail\.uneven: .*up to 0\.\d{3} mm off every even motion.*allowed 0\.022 mm: 2 counts"),
        ({"bend": -0.5e-3}, r"rail\.uneven"),
    ],
    ids=str,
)
def test_a_sweep_that_was_not_as_commanded_has_no_window(made: dict[str, float], told: str):
    ended = sweep(**made)  # type: ignore[arg-type]
    ended.wait(50.0)
    with pytest.raises(DeviceFault) as caught:
        _ = ended.window
    assert re.match(told, f"{caught.value.code}: {caught.value}")


@pytest.mark.parametrize("ran", [0.0192, 0.0208])
def test_a_velocity_within_what_is_allowed_is_the_one_that_was_measured(ran: float):
    ended = sweep(ran=ran)
    ended.wait(50.0)
    begin, end = ended.window
    assert end - begin == pytest.approx(0.04 / ran, rel=1e-6)
