"""A device's clock on the host's, where that clock was set while nobody looked."""

import math
import threading

import pytest

from drivers.clock import MAX_DRIFT, Clock, ClockMap, Latch


def latch(host: float, ahead: float, half: float) -> Latch:
    """At `host` s the device's clock, which runs 20 ppm fast, reads `ahead` s more; the round trip is twice `half`."""
    return Latch(host - half, host * (1.0 + 20e-6) + ahead, host + half)


@pytest.mark.parametrize("jump", [-900.0, -0.02, 0.02, 900.0])
def test_a_clock_that_was_set_is_read_by_what_it_told_since(jump: float):
    """The earlier latches have the shorter round trips: they alone must not decide."""
    clocks = ClockMap()
    for host in range(0, 100, 10):
        clocks.add([latch(host, 1000.0, 50e-6)])
    assert clocks.drift == pytest.approx(-20e-6, abs=2e-6)
    clocks.add([latch(100.0, 1000.0 + jump, 200e-6)])
    assert clocks.host_time(latch(101.0, 1000.0 + jump, 0.0).device) == pytest.approx(101.0, abs=1e-3)
    assert clocks.bound_at(101.0) == pytest.approx(200e-6 + MAX_DRIFT, rel=1e-6)


def test_a_clock_that_runs_on_keeps_what_was_learned_of_it():
    clocks = ClockMap()
    for host, half in ((0.0, 50e-6), (60.0, 50e-6), (120.0, 400e-6), (180.0, 3e-3)):
        clocks.add([latch(host, 5.0, half)])
    assert clocks.drift == pytest.approx(-20e-6, abs=20e-6)
    assert clocks.uncertainty < 2e-3


def test_the_shortest_of_several_round_trips_counts():
    exact, late = latch(10.0, 5.0, 20e-6), Latch(10.0, 10.0 + 5.0 + 10.0 * 20e-6, 10.4)
    for order in ([exact, late], [late, exact]):
        clocks = ClockMap()
        clocks.add(order)
        assert clocks.host_time(exact.device) == pytest.approx(10.0, abs=1e-6)
        assert clocks.bound_at(10.0) == pytest.approx(20e-6)


def test_the_bound_holds_a_clock_that_drifts_before_and_after_its_latches():
    """Also long after them, where what is not known of the drift is more than the round trips."""
    clocks = ClockMap()
    for host in (0.0, 10.0):
        clocks.add([latch(host, 5.0, 400e-6)])
    for host in (-50.0, 5.0, 11.0, 200.0):
        off = abs(clocks.host_time(latch(host, 5.0, 0.0).device) - host)
        assert off <= clocks.bound_at(host)
    assert clocks.bound_at(200.0) > clocks.bound_at(20.0) > clocks.bound_at(10.0)


def test_a_wait_without_end_ends_with_the_event():
    over = threading.Event()
    threading.Timer(0.02, over.set).start()
    assert Clock().wait(over, math.inf)


def test_a_drift_that_is_known_carries_far():
    clocks = ClockMap()
    for host in (0.0, 1000.0):
        clocks.add([latch(host, 5.0, 50e-6)])
    assert clocks.host_time(latch(2000.0, 5.0, 0.0).device) == pytest.approx(2000.0, abs=0.5e-3)


def test_the_bound_holds_for_a_crystal_that_warms_up():
    """By 10 ppm within 10 min, latched each half minute, mostly with a longer round trip; also 20 s after a latch."""
    clocks = ClockMap()
    for host in range(0, 3600, 30):
        half = 300e-6 if host % 300 else 50e-6
        for at in (host, host + 20.0):
            device = at + 10e-6 * (at - 600.0 * (1.0 - math.exp(-at / 600.0)))
            if at == host:
                clocks.add([Latch(at - half, device, at + half)])
            assert abs(clocks.host_time(device) - at) <= clocks.bound_at(at) <= 2.2e-3
