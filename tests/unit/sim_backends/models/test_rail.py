"""The simulated rail's physics against closed forms."""

import numpy as np
import pytest

from sim_backends.models.rail import RailModel, RailParams, RailSettings
from sim_backends.models.ramp import Screw

STEPS = 200 * 256
LEAD = 0.002


def rail(seed: int = 1, **params: object) -> RailModel:
    return RailModel(RailParams(**params), np.random.default_rng(seed))  # type: ignore[arg-type]


def test_a_stop_on_the_way_ends_the_motion_on_the_ramp_and_the_past_stays_as_it_was():
    model = rail()
    model.configure(0.0, RailSettings(max_velocity=5 * STEPS, max_acceleration=20 * STEPS))
    model.rotate(0.0, 5 * STEPS)
    before = model.carriage(1.5)
    model.rotate(2.0, 0)
    assert model.carriage(1.5) == before
    assert model.carriage(9.0) - model.carriage(2.0) == pytest.approx(LEAD * 5.0**2 / (2 * 20.0), abs=1e-12)


def test_the_carriage_shows_lead_error_periodic_error_and_backlash():
    screw = Screw(scale_error=1e-3, periodic=4e-6, phase=0.7, backlash=12e-6)
    model = rail(screw=screw, start=0.0)

    def stands_at(t: float, turns: int) -> float:
        model.move_to(t, turns * STEPS)
        return model.carriage(t + 20.0)

    up_40, _, up_20 = stands_at(0.0, 40), stands_at(100.0, 0), stands_at(200.0, 20)
    _, down_20 = stands_at(300.0, 40), stands_at(400.0, 20)
    # Whole turns: the periodic error is the same everywhere, so only lead error and backlash are left.
    assert up_40 - up_20 == pytest.approx(20 * LEAD * 1.001, abs=1e-12)
    assert down_20 - up_20 == pytest.approx(12e-6 * 1.001, rel=0.02)
    model.rotate(500.0, -STEPS // 4)
    travel = np.array([model.carriage(t) for t in np.arange(502.0, 526.0, 0.004)])
    ideal = -LEAD * 1.001 * 0.25 * np.arange(len(travel)) * 0.004
    residual = travel - ideal - np.mean(travel - ideal)
    assert np.max(residual) == pytest.approx(4e-6, rel=0.01)
    assert np.min(residual) == pytest.approx(-4e-6, rel=0.01)


def test_searches_scatter_by_the_repeatability():
    model = rail(repeatability=5e-6)
    model.configure(0.0, RailSettings(search_mode=5))
    edges = []
    for i in range(400):
        model.search(20.0 * i)
        edges.append(model.carriage(20.0 * i + 19.0))
        assert model.position(20.0 * i + 19.0) == 0
    assert (np.mean(edges), np.std(edges)) == (pytest.approx(0.0, abs=1e-6), pytest.approx(5e-6, rel=0.15))


@pytest.mark.parametrize("soft", [False, True])
def test_a_limit_switch_stops_the_motor_at_once_or_on_the_ramp(soft: bool):
    model = rail()
    model.configure(0.0, RailSettings(max_velocity=5 * STEPS, max_acceleration=20 * STEPS, soft_stop=soft))
    model.rotate(0.0, 5 * STEPS)
    beyond = LEAD * 5.0**2 / (2 * 20.0) if soft else 0.0
    assert model.carriage(29.0) == pytest.approx(0.102 + beyond, abs=1e-9)
    assert not model.stalled(29.0)


@pytest.mark.parametrize(("mode", "turns"), [(1, 0), (2, 52), (3, 52), (6, 0)])
def test_a_search_of_both_switches_finds_their_distance(mode: int, turns: int):
    model = rail()
    model.configure(0.0, RailSettings(search_mode=mode))
    model.search(0.0)
    assert model.switch_distance() == turns * STEPS
