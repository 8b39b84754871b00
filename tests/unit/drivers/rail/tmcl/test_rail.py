"""The rail's driver on the simulated rail's wire, its motions against the simulated carriage."""

from __future__ import annotations

import itertools
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from drivers.clock import Clock
from drivers.errors import (
    Aborted,
    ConfigError,
    DeadlineError,
    DeviceError,
    DeviceFault,
    InterlockError,
    LimitError,
    NotConnectedError,
)
from drivers.interfaces import LinkStatistics, Rail
from drivers.rail.motion import move_duration, run_up_distance
from drivers.rail.sweep import fit_line
from drivers.rail.tmcl.link import Axis, TmclLink
from drivers.rail.tmcl.rail import TmclRail
from sim_backends.clock import WorldClock
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.peers.rail.tmcl import TmclPeer
from tests.support.wire.clocks import ahead

SPEED = 5.0
MAX_SPEED = 0.05
ACCELERATION = 0.25


@dataclass
class Bench:
    """A rail on its wire: the driver, the carriage's truth and the two clocks' difference."""

    rail: TmclRail
    model: RailModel
    peer: TmclPeer
    world: WorldClock
    clock: Clock

    def carriage(self, host_time: float | None = None) -> float:
        """True place of the carriage in m, at a host time of the past or now."""
        if host_time is None:
            return self.model.carriage(self.world.now())
        return self.model.carriage(host_time - ahead(self.clock, self.world))


def connect(
    url: str,
    clock: Clock,
    travel: tuple[float, float] = (0.0, 0.1),
    address: int = 1,
    control: bool = True,
    reversed: bool = False,
    reference_mode: int = 5,
) -> TmclRail:
    return TmclRail(
        "rail",
        url,
        lead=0.002,
        steps_per_turn=200,
        microsteps=256,
        travel=travel,
        max_speed=MAX_SPEED,
        acceleration=ACCELERATION,
        address=address,
        motor=0,
        reference_mode=reference_mode,
        reversed=reversed,
        control=control,
        clock=clock,
    )


@pytest.fixture
def bench() -> Iterator[Bench]:
    world, clock = WorldClock(SPEED), Clock(SPEED)
    model = RailModel(RailParams(), np.random.default_rng(3))
    peer = TmclPeer(model, world)
    peer.start()
    rail = connect(peer.url, clock)
    try:
        yield Bench(rail, model, peer, world, clock)
    finally:
        try:
            rail.close()
        finally:
            peer.stop()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("rail motion")]


@pytest.fixture
def homed(bench: Bench) -> Bench:
    bench.rail.home().wait(20.0)
    return bench


def telegram(command: int, kind: int, value: int) -> bytes:
    """A request to the module at address 1, motor 0."""
    body = bytes([1, command, kind, 0]) + value.to_bytes(4, "big", signed=True)
    return body + bytes([sum(body) & 0xFF])


# --- helpers with closed forms ---


def test_ramps_follow_from_speed_and_acceleration() -> None:
    assert run_up_distance(0.2, 0.5) == pytest.approx(0.04)
    assert move_duration(0.2, 0.2, 0.5) == pytest.approx(2 * 0.4 + (0.2 - 0.08) / 0.2)
    assert move_duration(-0.02, 0.2, 0.5) == pytest.approx(2 * np.sqrt(0.02 / 0.5))


def test_one_late_sample_does_not_bend_the_line() -> None:
    times = np.linspace(10.0, 12.0, 40)
    positions = 0.01 + 0.02 * (times - 10.0)
    trips = np.full(40, 0.001)
    times[30] += 0.25
    trips[30] = 0.5
    origin, velocity = fit_line(times, positions, trips)
    assert velocity == pytest.approx(0.02, rel=1e-4)
    assert origin + velocity * 11.0 == pytest.approx(0.03, abs=1e-6)


@pytest.mark.parametrize("wrong", [{"lead": 0.0}, {"microsteps": 100}, {"travel": (0.1, 0.0)}, {"acceleration": -1.0}])
def test_impossible_parameters_are_refused_before_the_port_is_opened(wrong: dict[str, object]) -> None:
    settings: dict[str, object] = {
        "lead": 0.002,
        "steps_per_turn": 200,
        "microsteps": 256,
        "travel": (0.0, 0.1),
        "max_speed": 0.05,
        "acceleration": 0.5,
        **wrong,
    }
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        TmclRail("rail", "socket://127.0.0.1:1", clock=Clock(), **settings)  # type: ignore[arg-type]


# --- on the wire ---


@pytest.mark.wire
def test_the_rail_says_who_it_is_and_how_fast_it_answers(bench: Bench) -> None:
    rail: Rail = bench.rail
    identity = rail.identity()
    assert (identity.model, identity.serial, identity.firmware) == ("TMCM-1260", "1", "1260V112")
    assert identity.address == bench.peer.url
    assert 0.0 < rail.ping() < 0.5
    assert len(rail.statistics.round_trips_s) > 5
    assert not rail.statistics.errors


@pytest.mark.wire
def test_nothing_moves_before_homing(bench: Bench) -> None:
    before = bench.carriage()
    with pytest.raises(InterlockError, match="home"):
        bench.rail.move_to(0.05)
    assert not bench.rail.state().homed
    assert bench.carriage() == before


@pytest.mark.wire
def test_homing_puts_zero_at_the_switch(homed: Bench) -> None:
    state = homed.rail.state()
    assert state.homed
    assert not state.moving
    assert state.position == 0.0
    assert homed.carriage() == pytest.approx(0.0, abs=1e-6)


@pytest.mark.wire
def test_a_move_ends_where_it_was_sent(homed: Bench) -> None:
    motion = homed.rail.move_to(0.0421, speed=0.03)
    assert not motion.done
    motion.wait(10.0)
    assert motion.done
    assert homed.rail.state().position == pytest.approx(0.0421, abs=1e-8)
    assert homed.carriage() == pytest.approx(0.0421, abs=1e-6)


@pytest.mark.wire
def test_limits_are_checked_before_anything_is_sent(homed: Bench) -> None:
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


@pytest.mark.wire
@pytest.mark.parametrize(("start", "stop"), [(0.02, 0.06), (0.06, 0.02)])
def test_a_sweep_knows_its_position_at_any_time_to_some_micrometres(homed: Bench, start: float, stop: float) -> None:
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
def test_late_replies_shift_a_sweep_within_the_bound_that_it_states(homed: Bench) -> None:
    start, stop, speed = 0.02, 0.06, 0.005
    homed.rail.move_to(homed.rail.sweep_start(start, stop, speed)).wait(10.0)
    homed.peer.fault("rail.late_reply")
    sweep = homed.rail.sweep(start, stop, speed)
    sweep.wait(30.0)
    begin, end = sweep.window
    times = np.linspace(begin, end, 50)[5:-5]
    late = np.array([homed.carriage(time) - sweep.position_at(time) for time in times]) / speed
    # 0.2 s on the wall, half of which the middle of the round trip is off; and nothing but the round trips shows it.
    assert late.mean() == pytest.approx(0.1 * SPEED, rel=0.1)
    assert sweep.time_bound == pytest.approx(0.1 * SPEED, rel=0.1)
    # The bench's two clocks are compared to a millisecond only.
    assert late.max() <= sweep.time_bound + 0.005
    assert sweep.unevenness == 0.0


@pytest.mark.wire
def test_a_sweep_that_somebody_slowed_down_is_a_fault_with_both_velocities(homed: Bench) -> None:
    homed.rail.move_to(homed.rail.sweep_start(0.02, 0.06, 0.04)).wait(10.0)
    sweep = homed.rail.sweep(0.02, 0.06, 0.04)
    settings = homed.model.settings
    slower = replace(settings, max_velocity=round(0.9 * settings.max_velocity))
    homed.model.configure(homed.world.now(), slower)
    sweep.wait(10.0)
    with pytest.raises(DeviceFault, match=r"ran at 3[567]\.\d+ mm/s instead of 40\.000 mm/s") as caught:
        _ = sweep.window
    assert caught.value.code == "rail.velocity"


@pytest.mark.wire
def test_a_sweep_starts_only_where_its_start_up_fits(homed: Bench) -> None:
    with pytest.raises(InterlockError, match="sweep_start"):
        homed.rail.sweep(0.03, 0.06, 0.02)


@pytest.mark.wire
def test_stop_overtakes_a_running_motion(homed: Bench) -> None:
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


@pytest.mark.wire
def test_a_stopped_search_leaves_the_rail_unhomed(bench: Bench) -> None:
    motion = bench.rail.home()
    bench.rail.stop()
    with pytest.raises(Aborted):
        motion.wait(5.0)
    assert not bench.rail.state().homed
    bench.rail.home().wait(20.0)
    assert bench.rail.state().homed


@pytest.mark.wire
def test_a_wait_that_runs_out_stops_the_rail(homed: Bench) -> None:
    motion = homed.rail.move_to(0.09, speed=0.005)
    with pytest.raises(DeadlineError, match="was stopped"):
        motion.wait(1.0)
    homed.clock.sleep(0.5)
    assert homed.rail.state().velocity == 0.0
    assert homed.carriage() < 0.05


@pytest.mark.wire
def test_a_lost_reply_is_asked_for_once_more_and_counted(homed: Bench) -> None:
    homed.peer.fault("rail.drop_reply")
    homed.rail.move_to(0.03).wait(20.0)
    assert homed.carriage() == pytest.approx(0.03, abs=1e-6)
    assert homed.rail.statistics.errors["retries"] == 1
    assert homed.rail.statistics.errors["timeouts"] == 1


@pytest.mark.wire
def test_a_limit_switch_on_the_way_is_a_fault_that_names_it(bench: Bench) -> None:
    rail = connect(bench.peer.url, bench.clock, travel=(0.0, 0.12))
    rail.home().wait(20.0)
    with pytest.raises(DeviceFault, match="right limit switch") as caught:
        rail.move_to(0.11).wait(20.0)
    assert caught.value.code == "rail.limit_switch"
    with pytest.raises(InterlockError, match="home"):
        rail.move_to(0.05)
    rail.close()
    # Somebody turns it off the switch by hand: that does not make the count right.
    bench.model.rotate(bench.world.now(), -51_200)
    bench.clock.sleep(2.0)
    again = connect(bench.peer.url, bench.clock)
    assert not again.state().right_switch
    assert not again.state().homed
    again.close()


# --- a zero that is lost, and one that is found again ---


@pytest.mark.wire
def test_the_next_program_finds_the_rail_homed_and_its_zero_where_it_was(homed: Bench) -> None:
    homed.rail.move_to(0.005).wait(10.0)
    homed.rail.close()
    again = connect(homed.peer.url, homed.clock)
    state = again.state()
    assert (state.homed, state.position) == (True, 0.005)
    again.move_to(0.010).wait(10.0)
    assert homed.carriage() == pytest.approx(0.010, abs=1e-6)
    again.close()


@pytest.mark.wire
def test_the_zero_of_another_configuration_is_not_taken_nor_given_back(homed: Bench) -> None:
    homed.rail.close()
    other = TmclRail(
        "rail", homed.peer.url, lead=0.004, steps_per_turn=200, microsteps=256, travel=(0.0, 0.1), max_speed=MAX_SPEED,
        acceleration=ACCELERATION, clock=homed.clock,
    )  # fmt: skip
    assert not other.state().homed
    with pytest.raises(InterlockError, match="not homed"):
        other.move_to(0.01)
    other.close()
    # The other program has set the module up for itself since.
    again = connect(homed.peer.url, homed.clock)
    assert not again.state().homed
    again.close()


@pytest.mark.wire
def test_a_module_set_to_other_microsteps_is_not_homed_any_more(homed: Bench) -> None:
    homed.rail.close()
    homed.peer.module.handle(telegram(5, 140, 7))
    again = connect(homed.peer.url, homed.clock)
    assert not again.state().homed
    again.close()


@pytest.mark.wire
def test_a_stall_that_nobody_watched_ends_the_trust_in_the_zero(homed: Bench) -> None:
    homed.rail.close()
    homed.peer.module.handle(telegram(5, 13, 1))  # without its left limit switch
    homed.model.rotate(homed.world.now(), -5 * 51_200)
    homed.clock.sleep(3.0)
    homed.model.rotate(homed.world.now(), 5 * 51_200)
    homed.clock.sleep(1.0)
    again = connect(homed.peer.url, homed.clock)
    assert not again.state().left_switch
    assert not again.state().homed
    again.close()


@pytest.mark.wire
def test_a_motor_that_stalls_before_its_target_loses_the_zero(bench: Bench) -> None:
    bench.model.params = replace(bench.model.params, ends=(-0.004, 0.08))  # something lies in the carriage's way
    rail = connect(bench.peer.url, bench.clock)
    rail.home().wait(20.0)
    with pytest.raises(DeviceFault, match="stall detected") as caught:
        rail.move_to(0.09).wait(30.0)
    assert caught.value.code == "rail.stalled"
    assert not rail.state().homed
    rail.close()
    # The flag is gone once it has moved off the end; that does not make the count right.
    bench.model.rotate(bench.world.now(), -51_200)
    bench.clock.sleep(2.0)
    again = connect(bench.peer.url, bench.clock)
    assert not again.state().homed
    again.close()


@pytest.mark.wire
def test_a_rail_that_somebody_left_at_a_limit_switch_is_not_homed_any_more(bench: Bench) -> None:
    rail = connect(bench.peer.url, bench.clock, travel=(0.0, 0.12))
    rail.home().wait(20.0)
    rail.close()
    bench.model.rotate(bench.world.now(), 10 * 51_200)
    bench.clock.sleep(7.0)
    again = connect(bench.peer.url, bench.clock, travel=(0.0, 0.12))
    state = again.state()
    assert state.right_switch
    assert not state.homed
    again.close()


@pytest.mark.wire
def test_a_reset_between_two_motions_is_told_before_anything_moves(homed: Bench) -> None:
    homed.rail.move_to(0.03).wait(10.0)
    homed.peer.fault("rail.reset")
    with pytest.raises(DeviceFault, match="lost its zero") as caught:
        homed.rail.move_to(0.01)
    assert caught.value.code == "rail.reset"
    with pytest.raises(InterlockError, match="home"):
        homed.rail.move_to(0.01)
    assert homed.carriage() == pytest.approx(0.03, abs=1e-6)


@pytest.mark.wire
def test_a_position_read_after_a_reset_is_a_fault_and_then_that_of_a_rail_not_homed(homed: Bench) -> None:
    homed.rail.move_to(0.03).wait(10.0)
    homed.peer.fault("rail.reset")
    with pytest.raises(DeviceFault) as caught:
        homed.rail.state()
    assert caught.value.code == "rail.reset"
    assert not homed.rail.state().homed


@pytest.mark.wire
@pytest.mark.parametrize("goal", [0.05, 0.0])
def test_a_reset_on_the_way_is_never_an_arrival(homed: Bench, goal: float) -> None:
    homed.rail.move_to(0.03).wait(10.0)
    motion = homed.rail.move_to(goal, speed=0.01)
    homed.clock.sleep(1.0)
    homed.peer.fault("rail.reset")
    with pytest.raises(DeviceFault, match="Home the rail again") as caught:
        motion.wait(20.0)
    assert caught.value.code == "rail.reset"
    assert caught.value.recoverable


@pytest.mark.wire
def test_a_reset_in_a_sweep_leaves_no_window(homed: Bench) -> None:
    homed.rail.move_to(homed.rail.sweep_start(0.02, 0.06, 0.02)).wait(10.0)
    sweep = homed.rail.sweep(0.02, 0.06, 0.02)
    homed.clock.sleep(1.0)
    homed.peer.fault("rail.reset")
    with pytest.raises(DeviceFault) as caught:
        sweep.wait(20.0)
    assert caught.value.code == "rail.reset"
    with pytest.raises(DeviceFault):
        _ = sweep.window


@pytest.mark.wire
def test_a_reset_in_the_search_does_not_end_it_well(bench: Bench) -> None:
    motion = bench.rail.home()
    bench.clock.sleep(0.2)
    bench.peer.fault("rail.reset")
    with pytest.raises(DeviceFault) as caught:
        motion.wait(20.0)
    assert caught.value.code == "rail.reset"
    assert not bench.rail.state().homed


@pytest.mark.wire
def test_homing_after_a_reset_sets_the_module_up_again(homed: Bench) -> None:
    homed.peer.fault("rail.reset")
    homed.rail.home().wait(20.0)
    homed.rail.move_to(0.02).wait(10.0)
    assert homed.carriage() == pytest.approx(0.02, abs=1e-6)
    assert homed.model.settings.search_mode == 5
    assert homed.model.settings.max_acceleration == round(ACCELERATION * 200 * 256 / 0.002)


@pytest.mark.wire
def test_a_target_changed_by_another_is_not_reported_as_arrival(homed: Bench) -> None:
    motion = homed.rail.move_to(0.05, speed=0.02)
    homed.model.move_to(homed.world.now(), 1000)
    with pytest.raises(DeviceFault, match="changed the module's target"):
        motion.wait(20.0)


@pytest.mark.wire
def test_a_peer_that_dies_in_mid_move_is_a_fault_at_once(homed: Bench) -> None:
    motion = homed.rail.move_to(0.09, speed=0.005)
    homed.peer.stop()
    with pytest.raises(DeviceFault) as caught:
        motion.wait(100.0)
    assert caught.value.code == "rail.link_lost"
    with pytest.raises(DeviceFault):
        homed.rail.close()
    homed.rail.close()
    with pytest.raises(NotConnectedError):
        homed.rail.state()


@pytest.mark.wire
def test_a_pseudo_terminal_does_as_well() -> None:
    clock = Clock(SPEED)
    peer = TmclPeer(RailModel(RailParams(), np.random.default_rng(1)), WorldClock(SPEED), pty=True)
    peer.start()
    try:
        assert peer.pty is not None
        rail = connect(peer.pty, clock)
        rail.home().wait(20.0)
        assert rail.state().position == 0.0
        rail.close()
    finally:
        peer.stop()


def test_a_port_that_is_not_there_is_named() -> None:
    with pytest.raises(NotConnectedError, match="/dev/no-such-port"):
        connect("/dev/no-such-port", Clock())


@pytest.mark.wire
def test_a_silent_module_is_a_deadline(bench: Bench) -> None:
    with pytest.raises(DeadlineError, match="module address 9"):
        connect(bench.peer.url, bench.clock, address=9)


# --- a module that answers badly ---


@pytest.fixture
def module() -> Iterator[Callable[[Callable[[bytes], bytes]], str]]:
    """Starts a module that gives `answer(request)` to each request, but tells its settings as they were set.

    Returns its URL.
    """
    listener = socket.create_server(("127.0.0.1", 0))
    settings = {255: 1}
    threads: list[threading.Thread] = []

    def start(answer: Callable[[bytes], bytes]) -> str:
        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                while request := connection.recv(9):
                    if request[1] == 5:
                        settings[request[2]] = int.from_bytes(request[4:8], "big", signed=True)
                    told = request[1] == 6 and request[2] in settings
                    connection.sendall(reply(request, settings[request[2]]) if told else answer(request))

        threads.append(threading.Thread(target=serve, daemon=True))
        threads[-1].start()
        return f"socket://127.0.0.1:{listener.getsockname()[1]}"

    yield start
    for thread in threads:
        thread.join(2.0)
        assert not thread.is_alive()
    listener.close()


def reply(request: bytes, value: int = 0, status: int = 100) -> bytes:
    if request[1] == 136:
        return b"\x021260V112"
    body = bytes([2, request[0], status, request[1]]) + value.to_bytes(4, "big", signed=True)
    return body + bytes([sum(body) & 0xFF])


@pytest.mark.wire
def test_a_left_over_answer_is_never_taken_for_the_next_ones(module: Callable[..., str]) -> None:
    # To every request this module sends its answer and, unasked, an older position of 51.2 mm behind it.
    def answer(request: bytes) -> bytes:
        return reply(request, 0) + reply(bytes([1, 6, 1, 0]), 1_310_720)

    rail = connect(module(answer), Clock())
    assert [rail.state().position for _ in range(3)] == [0.0, 0.0, 0.0]
    assert rail.statistics.errors["stale_input"] >= 3
    rail.close()


@pytest.mark.wire
@pytest.mark.parametrize("late", [0.2, 0.6, 0.9])
def test_late_answers_never_become_those_to_later_questions(late: float) -> None:
    """Two replies are late, those behind them come at once after them: a position is that of its time, or an error."""
    listener, asked, ready = socket.create_server(("127.0.0.1", 0)), itertools.count(), threading.Event()

    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            while request := connection.recv(9):
                value = 1 if request[1] == 6 and request[2] == 255 else round(25_600 * time.monotonic()) % 2**30
                if ready.is_set() and next(asked) < 2:
                    time.sleep(late)
                connection.sendall(reply(request, value if request[1] == 6 else 0))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    link = TmclLink(
        "rail", f"socket://127.0.0.1:{listener.getsockname()[1]}", address=1, motor=0, baud=9600, clock=Clock(),
        statistics=LinkStatistics(),
    )  # fmt: skip
    before, clock = time.monotonic(), link._clock
    offset = clock.now() - before
    ready.set()
    right = 0
    for _ in range(8):
        try:
            value, stamp, round_trip = link.get_stamped(Axis.POSITION)
        except DeadlineError:
            continue
        true = (stamp - offset) % (2**30 / 25_600)
        assert abs(value / 25_600 - true) <= 0.5 * round_trip + 0.01
        right += 1
    assert right >= 4
    link.close()
    listener.close()


@pytest.mark.wire
def test_answers_to_another_command_are_refused_twice_then_reported(module: Callable[..., str]) -> None:
    def answer(request: bytes) -> bytes:
        return reply(request) if request[1] != 6 else reply(bytes([1, 5]), 7)

    rail = connect(module(answer), Clock())
    with pytest.raises(DeadlineError, match="answer to command 5 instead of 6"):
        rail.state()
    assert rail.statistics.errors["bad_replies"] == 2
    rail.close()


@pytest.mark.wire
@pytest.mark.parametrize("answers", ["refuses", "nothing"])
def test_the_motor_is_told_to_stop_whatever_becomes_of_the_search_and_of_the_replies(
    module: Callable[..., str], answers: str
) -> None:
    """A search that cannot be ended, and a module that cannot be heard, which may hear."""
    heard: list[int] = []

    def answer(request: bytes) -> bytes:
        if not heard:
            return reply(request)
        heard.append(request[1])
        return b"" if answers == "nothing" else reply(request, status=6 if request[1] == 13 else 100)

    rail = connect(module(answer), Clock())
    heard.append(0)
    with pytest.raises(DeadlineError if answers == "nothing" else DeviceFault):
        rail.stop()
    assert 3 in heard
    with suppress(DeviceError, DeadlineError):
        rail.close()


@pytest.mark.wire
def test_a_refusal_of_the_module_is_a_fault_in_words(module: Callable[..., str]) -> None:
    with pytest.raises(DeviceFault, match="invalid value") as caught:
        connect(module(lambda request: reply(request, status=4)), Clock())
    assert caught.value.code == "tmcl.refused"


@pytest.mark.wire
def test_a_module_that_lets_neither_first_phase_be_off_gets_no_acceleration_for_a_speed(
    module: Callable[..., str],
) -> None:
    """Of parameters 15 and 16 one is a speed, and modules differ in which."""
    told: list[int] = []

    def answer(request: bytes) -> bytes:
        if request[1] != 5 or request[2] not in (15, 16):
            return reply(request)
        told.append(request[2])
        return reply(request, status=100 if any(request[4:8]) else 4)

    with pytest.raises(DeviceFault, match="command 5, type 16, value 0: invalid value"):
        connect(module(answer), Clock())
    assert told == [15, 15, 16]


@pytest.mark.wire
def test_a_zero_that_was_lost_is_not_trusted_though_the_module_cannot_be_told(module: Callable[..., str]) -> None:
    variables: dict[int, int] = {}
    full = False

    def answer(request: bytes) -> bytes:
        command, kind, value = request[1], request[2], int.from_bytes(request[4:8], "big", signed=True)
        if command == 9:
            if full:
                return reply(request, status=5)
            variables[kind] = value
        # It stands at 0 and at its right limit switch, whatever it is told.
        known = {(10, kind): variables.get(kind, 0), (6, 10): 1, (6, 0): 1_280_000}
        return reply(request, known.get((command, kind), 0))

    rail = connect(module(answer), Clock())
    rail.home().wait(10.0)
    assert rail.state().homed
    full = True
    with pytest.raises(DeviceFault, match="right limit switch"):
        rail.move_to(0.05).wait(10.0)
    assert not rail.state().homed
    rail.close()


@pytest.mark.wire
def test_who_only_looks_sets_nothing_and_stops_nothing(homed: Bench) -> None:
    homed.rail.close()
    homed.peer.module.handle(telegram(4, 0, round(0.09 / 0.002 * 200 * 256)))
    before = homed.model.settings
    looking = connect(homed.peer.url, homed.clock, control=False)
    state = looking.state()
    assert state.moving
    assert state.homed
    for command in (looking.home, lambda: looking.move_to(0.01), looking.stop):
        with pytest.raises(InterlockError, match="looked at only"):
            command()
    looking.close()
    assert homed.model.settings == before
    homed.clock.sleep(4.0)
    assert homed.carriage() == pytest.approx(0.09, abs=1e-5)


@pytest.mark.wire
def test_who_only_looks_trusts_no_doubtful_zero_and_leaves_it_to_who_controls(homed: Bench) -> None:
    homed.rail.close()
    homed.peer.module.handle(telegram(5, 140, 7))
    looking = connect(homed.peer.url, homed.clock, control=False)
    assert not looking.state().homed
    looking.close()
    assert homed.model.settings.microsteps == 7


@pytest.mark.parametrize("off", [1, -1, 2])
def test_a_module_that_stands_one_count_off_its_target_has_arrived(
    homed: Bench, monkeypatch: pytest.MonkeyPatch, off: int
) -> None:
    counted = homed.model.position
    monkeypatch.setattr(homed.model, "position", lambda t: counted(t) + off)
    motion = homed.rail.move_to(0.01)
    if abs(off) == 1:
        motion.wait(10.0)
        assert homed.rail.state().position == pytest.approx(0.01, abs=1e-7)
    else:
        with pytest.raises(DeviceFault, match=r"its target is|has not ended"):
            motion.wait(10.0)


@pytest.mark.parametrize(("lost", "refused"), [(0.0, False), (0.03e-3, False), (0.09e-3, True), (-0.09e-3, True)])
def test_a_count_that_is_off_by_more_than_a_twentieth_of_a_millimetre_is_refused(lost: float, refused: bool) -> None:
    world, clock = WorldClock(1.0), Clock(1.0)
    model = RailModel(RailParams(), np.random.default_rng(3))
    peer = TmclPeer(model, world)
    peer.start()
    try:
        rail = connect(peer.url, clock)
        rail.home().wait(20.0)
        counted = model.position(world.now())
        model.set_position(world.now(), counted + round(lost * 200 * 256 / 0.002))
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
        limited = connect(peer.url, clock, reference_mode=1)
        assert limited.check_zero() is None
        limited.close()
    finally:
        peer.stop()


@pytest.mark.parametrize(
    ("params", "fault", "mode", "told", "longest"),
    [
        ({"reversed": True, "start": 0.08}, "", 5, "rail.switches: .*the right limit switch tripped .* sent left", 3.0),
        ({"start": 0.02}, "rail.exchanged_switches", 1, "rail.switches: .*the right limit .* exchanged", 3.0),
        ({"reversed": True, "start": 0.09, "switches": (-1, 1)}, "", 5, "rail.stalled: .* no limit switch shows", 4.0),
        ({"reversed": True, "switches": (-1, 1), "ends": (-1, 1)}, "", 5, "rail.no_reference: .* over 11", 8.0),
    ],
)
def test_a_search_ends_at_the_first_sign_that_the_carriage_goes_elsewhere(
    params: dict[str, Any], fault: str, mode: int, told: str, longest: float
) -> None:
    """By a switch of the other side, by a count that stands, or after the travel and a margin."""
    world, clock = WorldClock(1.0), Clock(1.0)
    model = RailModel(RailParams(**params), np.random.default_rng(3))
    peer = TmclPeer(model, world)
    peer.start()
    try:
        rail = connect(peer.url, clock, reference_mode=mode)
        if fault:
            peer.fault(fault)
        begun = clock.now()
        with pytest.raises(DeviceFault) as met:
            rail.home().wait(30.0)
        assert re.search(told, f"{met.value.code}: {met.value}")
        assert clock.now() - begun < longest
        clock.sleep(0.3)
        low, high = model.params.ends
        assert "rail.switches" not in told or low + 1e-4 < model.carriage(world.now()) < high - 1e-4
        assert not rail.state().homed and not rail.state().moving
        rail.close()
    finally:
        peer.stop()


def test_a_rail_is_nudged_before_it_is_homed_and_a_motor_that_turns_backwards_is_turned_round() -> None:
    world, clock = WorldClock(SPEED), Clock(SPEED)
    model = RailModel(RailParams(reversed=True), np.random.default_rng(3))
    peer = TmclPeer(model, world)
    peer.start()
    try:
        rail = connect(peer.url, clock)
        before = model.carriage(world.now())
        rail.nudge(0.004, 0.02).wait(10.0)
        assert model.carriage(world.now()) - before == pytest.approx(-0.004, abs=1e-5)
        with pytest.raises(LimitError, match="distance of a nudge"):
            rail.nudge(0.02, 0.02)
        with pytest.raises(InterlockError, match="not homed"):
            rail.move_to(0.01)
        rail.close()
        rail = connect(peer.url, clock, reversed=True)
        rail.nudge(0.004, 0.02).wait(10.0)
        assert model.carriage(world.now()) == pytest.approx(before, abs=1e-5)
        rail.home().wait(20.0)
        assert model.carriage(world.now()) == pytest.approx(0.0, abs=1e-4)
        rail.close()
    finally:
        peer.stop()
