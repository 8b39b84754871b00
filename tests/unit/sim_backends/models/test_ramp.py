"""The rail's ramps and its screw against closed forms."""

import itertools

import numpy as np
import pytest

from sim_backends.models import ramp
from sim_backends.models.ramp import Screw


@pytest.mark.parametrize("x0, v0, target", [(0.0, 0.0, 10.0), (0.0, 3.0, 0.5), (2.0, -4.0, 8.0), (0.0, 6.0, 100.0)])
def test_a_ramp_arrives_at_rest_within_its_limits(x0: float, v0: float, target: float):
    pieces = ramp.to_position(5.0, x0, v0, target, 4.0, 2.0)
    times = np.linspace(5.0, pieces[-1].t + 1.0, 20001)
    states = np.array([next(p for p in reversed(pieces) if p.t <= t).at(t) for t in times])
    dt = times[1] - times[0]
    assert (states[0], states[-1]) == (pytest.approx([x0, v0]), pytest.approx([target, 0.0], abs=1e-12))
    assert np.max(np.abs(np.diff(states[:, 1]))) <= 2.0 * dt * (1 + 1e-9)
    assert np.max(np.abs(states[:, 1])) <= max(4.0, abs(v0)) + 1e-9
    np.testing.assert_allclose(np.diff(states[:, 0]), 0.5 * dt * (states[1:, 1] + states[:-1, 1]), atol=1e-6)


@pytest.mark.parametrize("x0, v0, target", [(0.0, 0.0, 10.0), (0.0, 0.0, 0.3), (0.0, 3.0, 0.5), (2.0, -4.0, 8.0)])
def test_a_ramp_of_six_points_changes_speed_by_each_of_its_slopes(x0: float, v0: float, target: float):
    slopes = ramp.Slopes(up=2.0, down=1.0, first_speed=0.5, first_up=0.8, last_down=0.6)
    pieces = ramp.to_position(0.0, x0, v0, target, 4.0, slopes)
    assert pieces[-1].at(pieces[-1].t + 1.0) == pytest.approx((target, 0.0))
    for piece, after in itertools.pairwise(pieces):
        end = piece.at(after.t)
        assert end == pytest.approx((after.x, after.v), abs=1e-6), "no jump"
        if piece.a:
            faster = abs(end[1]) > abs(piece.v)
            below = max(abs(end[1]), abs(piece.v)) <= 0.5 + 1e-9
            wanted = (0.8 if below else 2.0) if faster else (0.6 if below else 1.0)
            assert abs(piece.a) == pytest.approx(wanted)


@pytest.mark.parametrize("travel", [-0.004, 0.0, 0.0501, 0.104])
def test_the_screw_is_inverted_exactly(travel: float):
    screw = Screw(scale_error=-2e-3, periodic=8e-6, phase=2.0)
    assert screw.travel(screw.nut(travel)) == pytest.approx(travel, abs=1e-15)
