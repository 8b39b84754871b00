"""Promises of `sim_backends.models.followed`."""

import numpy as np
import pytest

from sim_backends.models.followed import Track


def track(*rows: tuple[float, float]) -> Track:
    made = Track()
    for t, value in rows:
        assert made.append(t, np.array([value]))
    return made


def test_between_two_readings_a_device_goes_straight_and_beyond_them_it_is_where_it_was_seen():
    told = track((1.0, 0.0), (2.0, 10.0), (4.0, 30.0))
    assert [float(told.at(t)[0]) for t in (0.5, 1.0, 1.5, 3.0, 4.0, 9.0)] == [0.0, 0.0, 5.0, 20.0, 30.0, 30.0]
    assert (told.until, told.seconds(3.0)) == (4.0, 2.0)
    assert not told.append(4.0, np.array([31.0]))


@pytest.mark.parametrize("way", [lambda t: 0.015 * t, lambda t: 0.02], ids=["even", "at rest"])
def test_an_even_motion_is_known_across_a_gap(way):
    told = track(*((t, way(t)) for t in (-0.05, -0.04, 0.0, 0.010, 0.020, 0.120, 0.130, 0.180, 0.2)))
    assert (told.doubt(0.07), told.at(0.07)[0]) == (pytest.approx(0.0, abs=1e-12), pytest.approx(way(0.07)))


@pytest.mark.parametrize("start", [0.0, 0.03, 0.05, 0.09])
def test_what_bends_in_a_gap_is_within_its_stated_doubt(start: float):
    """A ramp at 0.2 m/s² that begins somewhere around a gap of 80 ms."""

    def way(t: float) -> float:
        return 0.1 * max(0.0, t - start) ** 2

    told = track(*((t, way(t)) for t in (*np.arange(-0.10, 0.031, 0.01), *np.arange(0.11, 0.25, 0.01))))
    off = max(abs(float(told.at(t)[0]) - way(t)) for t in np.linspace(0.03, 0.11, 81))
    assert off <= told.doubt(0.07) < 12 * off


def test_as_long_as_nothing_came_after_a_gap_nobody_knows():
    assert track((0.0, 0.0), (0.01, 0.0), (0.11, 1.0)).doubt(0.05) == np.inf
