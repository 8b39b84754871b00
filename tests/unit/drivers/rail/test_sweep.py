"""What round trips tell of a rail's place in time: never less than the truth, as much as the shortest ones allow."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.interfaces import Vector
from drivers.rail.sweep import EvenMotion

SPEED = 0.015
DURATION = 4.0


def readings(n: int, late: float, share: float, seed: int, speed: float = SPEED) -> tuple[Vector, Vector, Vector]:
    """Readings of a motion that is at 0 m at time 0 s: times, positions, round trips.

    Ways to and fro take up to 0.4 ms each; of a `share` of the replies the way back takes `late` s more.
    """
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
def test_the_bound_holds_and_is_a_fraction_of_a_round_trip(seed: int, speed: float) -> None:
    line = EvenMotion.of(*readings(300, 0.0, 0.0, seed, speed))
    assert np.abs(errors(line, speed)).max() <= line.time_bound * (1 + 1e-6)
    assert line.time_bound < 0.00008


@pytest.mark.parametrize("late", [0.02, 0.2])
@pytest.mark.parametrize("n", [7, 60, 300])
def test_replies_that_are_all_late_are_known_as_an_unknown_of_half_of_it(n: int, late: float) -> None:
    line = EvenMotion.of(*readings(n, late, 1.0, n))
    # The trap: the readings lie on a perfect line, half of the lateness off.
    assert errors(line).mean() == pytest.approx(-late / 2, abs=0.0004)
    assert np.abs(errors(line)).max() <= line.time_bound * (1 + 1e-3)
    assert line.time_bound == pytest.approx(late / 2, abs=0.0005)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_as_long_as_some_replies_are_prompt_they_tell_the_time(share: float) -> None:
    line = EvenMotion.of(*readings(300, 0.2, share, 5))
    assert np.abs(errors(line)).max() < 0.0002
    assert line.time_bound < 0.002


def test_readings_that_contradict_an_even_motion_say_so_and_late_ones_do_not() -> None:
    times, positions, trips = readings(300, 0.0, 0.0, 1)
    stepped = EvenMotion.of(times, positions + np.where(times > 2.0, 0.0005, 0.0), trips)
    assert stepped.unevenness > 0.00003
    for share in (0.0, 0.3, 0.6, 1.0):
        assert EvenMotion.of(*readings(300, 0.2, share, 2)).unevenness < 1e-9


@pytest.mark.parametrize("speed", [SPEED, -SPEED])
@pytest.mark.parametrize("late", [0.0, 0.02])
def test_what_no_even_motion_explains_is_found_beside_prompt_and_late_replies(speed: float, late: float) -> None:
    """A parabola is off the best line by an eighth of its rise, at most; one that round trips explain is not off."""
    times, positions, trips = readings(300, late, 0.5, 3, speed)
    assert EvenMotion.of(times, positions, trips).residual == 0.0
    held = positions / speed
    bend = 0.002 * np.square(held / DURATION) * np.sign(speed)
    bent = EvenMotion.of(times, positions + bend, trips)
    assert 0.002 / 8 - SPEED * 0.0012 <= bent.residual <= 0.002 / 8
    slight = EvenMotion.of(times, positions + 1e-3 * bend, trips)
    assert slight.residual <= 1e-6
