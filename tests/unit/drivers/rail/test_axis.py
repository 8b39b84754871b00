"""Promises of `drivers.rail.axis`."""

import re
from typing import Any

import pytest

from drivers.errors import Aborted, DeadlineError, DeviceFault, InterlockError, LimitError
from sim_backends.models.rail import RailParams
from tests.support.wire.rail_bench import Bench, benched, connect

pytestmark = pytest.mark.wire


def test_limits_are_checked_before_anything_is_sent(homed: Bench):
    sent = len(homed.rail.statistics.round_trips_s)
    with pytest.raises(LimitError, match=r"position 120 mm is outside 0 mm to 100 mm"):
        homed.rail.move_to(0.12)
    with pytest.raises(LimitError, match=r"position nan"):
        homed.rail.move_to(float("nan"))
    with pytest.raises(LimitError, match=r"speed 60 mm/s .* 50 mm/s"):
        homed.rail.move_to(0.05, speed=0.06)
    with pytest.raises(LimitError, match="start-up"):
        homed.rail.sweep_start(0.0, 0.05, 0.02)
    with pytest.raises(LimitError, match="run-out"):
        homed.rail.sweep_start(0.05, 0.1, 0.02)
    assert len(homed.rail.statistics.round_trips_s) == sent


def test_a_sweep_starts_only_where_its_start_up_fits(homed: Bench):
    with pytest.raises(InterlockError, match="sweep_start"):
        homed.rail.sweep(0.03, 0.06, 0.02)


def test_stop_overtakes_a_running_motion(homed: Bench):
    motion = homed.rail.move_to(0.09, speed=0.01)
    with pytest.raises(InterlockError, match="another motion"):
        homed.rail.move_to(0.01)
    homed.clock.sleep(1.0)
    homed.rail.stop()
    homed.rail.stop()
    with pytest.raises(Aborted):
        motion.wait(5.0)
    homed.clock.sleep(0.5)
    stands = homed.carriage()
    assert 0.005 < stands < 0.05
    homed.clock.sleep(0.5)
    assert homed.carriage() == stands
    homed.rail.move_to(0.01).wait(10.0)
    assert homed.carriage() == pytest.approx(0.01, abs=1e-6)


def test_a_search_whose_stop_has_no_answer_is_not_told_as_stopped(bench: Bench):
    motion = bench.rail.home()
    for _ in range(100):
        bench.peer.fault("rail.drop_reply")
    with pytest.raises(DeadlineError):
        bench.rail.stop()
    with pytest.raises(DeviceFault, match="has not confirmed it") as told:
        motion.wait(10.0)
    assert told.value.code == "rail.not_stopped"
    bench.peer.clear()
    bench.rail.stop()


@pytest.mark.parametrize(
    ("params", "told", "longest"),
    [
        ({"reversed": True, "start": 0.08}, "rail.switches: .*the right limit switch tripped .* sent left", 3.0),
        ({"reversed": True, "start": 0.09, "switches": (-1, 1)}, "rail.stalled: .* no limit switch shows", 4.0),
        ({"reversed": True, "switches": (-1, 1), "ends": (-1, 1)}, "rail.no_reference: .* over 11", 8.0),
    ],
)
def test_a_search_ends_at_the_first_sign_that_the_carriage_goes_elsewhere(
    params: dict[str, Any], told: str, longest: float
):
    """By a switch of the other side, by a count that stands, or after the travel and a margin."""
    with benched(4.0, RailParams(**params)) as made:
        begun = made.clock.now()
        with pytest.raises(DeviceFault) as met:
            made.rail.home().wait(30.0)
        assert re.search(told, f"{met.value.code}: {met.value}")
        assert made.clock.now() - begun < longest
        made.clock.sleep(0.3)
        low, high = made.model.params.ends
        assert "rail.switches" not in told or low + 1e-4 < made.carriage() < high - 1e-4
        assert not made.rail.state().homed and not made.rail.state().moving


def test_a_rail_is_nudged_before_it_is_homed_and_a_motor_that_turns_backwards_is_turned_round():
    with benched(params=RailParams(reversed=True)) as made:
        rail, before = made.rail, made.carriage()
        rail.nudge(0.004, 0.02).wait(10.0)
        assert made.carriage() - before == pytest.approx(-0.004, abs=1e-5)
        with pytest.raises(LimitError, match="distance of a nudge"):
            rail.nudge(0.02, 0.02)
        with pytest.raises(InterlockError, match="not homed"):
            rail.move_to(0.01)
        rail.close()
        rail = connect(made.peer.url, made.clock, reversed=True)
        rail.nudge(0.004, 0.02).wait(10.0)
        assert made.carriage() == pytest.approx(before, abs=1e-5)
        rail.home().wait(20.0)
        assert made.carriage() == pytest.approx(0.0, abs=1e-4)
        rail.close()
