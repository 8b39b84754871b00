"""Promises of `drivers.rail.tmcl.module`."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceFault, InterlockError
from drivers.interfaces import Rail
from tests.support.wire.rail_bench import ACCELERATION, Bench, connect, reply, telegram

pytestmark = pytest.mark.wire


def require_not_homed(bench: Bench) -> None:
    """The next program does not trust the zero, at no switch."""
    again = connect(bench.peer.url, bench.clock)
    state = again.state()
    assert (state.homed, state.left_switch, state.right_switch) == (False, False, False)
    again.close()


@pytest.mark.parametrize(
    ("obstacle", "told", "code"),
    [(None, "right limit switch", "rail.limit_switch"), (0.08, "stall detected", "rail.stalled")],
)
def test_a_limit_switch_or_a_stall_on_the_way_is_a_fault_that_names_it_and_loses_the_zero(
    bench: Bench, obstacle: float | None, told: str, code: str
):
    if obstacle is not None:
        bench.model.params = replace(bench.model.params, ends=(-0.004, obstacle))
    rail = connect(bench.peer.url, bench.clock, travel=(0.0, 0.12))
    rail.home().wait(20.0)
    with pytest.raises(DeviceFault, match=told) as caught:
        rail.move_to(0.11).wait(30.0)
    assert caught.value.code == code
    assert not rail.state().homed
    with pytest.raises(InterlockError, match="home"):
        rail.move_to(0.05)
    rail.close()
    # Somebody turns it off the switch or the end by hand: that does not make the count right.
    bench.model.rotate(bench.world.now(), -51_200)
    bench.clock.sleep(2.0)
    require_not_homed(bench)


def test_the_next_program_finds_the_rail_homed_and_its_zero_where_it_was(homed: Bench):
    homed.rail.move_to(0.005).wait(10.0)
    homed.rail.close()
    again = connect(homed.peer.url, homed.clock)
    state = again.state()
    assert (state.homed, state.position) == (True, 0.005)
    again.move_to(0.010).wait(10.0)
    assert homed.carriage() == pytest.approx(0.010, abs=1e-6)
    again.close()


def test_the_zero_of_another_configuration_is_not_taken_nor_given_back(homed: Bench):
    homed.rail.close()
    other = connect(homed.peer.url, homed.clock, lead=0.004)
    assert not other.state().homed
    with pytest.raises(InterlockError, match="not homed"):
        other.move_to(0.01)
    other.close()
    # The other program has set the module up for itself since.
    require_not_homed(homed)


def test_a_stall_that_nobody_watched_ends_the_trust_in_the_zero(homed: Bench):
    homed.rail.close()
    homed.peer.module.handle(telegram(5, 13, 1))  # without its left limit switch
    homed.model.rotate(homed.world.now(), -5 * 51_200)
    homed.clock.sleep(3.0)
    homed.model.rotate(homed.world.now(), 5 * 51_200)
    homed.clock.sleep(1.0)
    require_not_homed(homed)


def test_a_rail_that_somebody_left_at_a_limit_switch_is_not_homed_any_more(bench: Bench):
    rail = connect(bench.peer.url, bench.clock, travel=(0.0, 0.12))
    rail.home().wait(20.0)
    rail.close()
    bench.model.rotate(bench.world.now(), 10 * 51_200)
    bench.clock.sleep(7.0)
    again = connect(bench.peer.url, bench.clock, travel=(0.0, 0.12))
    state = again.state()
    assert state.right_switch and not state.homed
    again.close()


@pytest.mark.parametrize("ask", [lambda rail: rail.move_to(0.01), lambda rail: rail.state()], ids=["move", "state"])
def test_a_reset_is_told_to_who_asks_next_and_the_rail_is_not_homed(homed: Bench, ask: Callable[[Rail], None]):
    homed.rail.move_to(0.03).wait(10.0)
    homed.peer.fault("rail.reset")
    with pytest.raises(DeviceFault, match="lost its zero") as caught:
        ask(homed.rail)
    assert caught.value.code == "rail.reset"
    assert not homed.rail.state().homed
    with pytest.raises(InterlockError, match="home"):
        homed.rail.move_to(0.01)
    assert homed.carriage() == pytest.approx(0.03, abs=1e-6)


def test_a_reset_on_the_way_to_0_is_never_an_arrival(homed: Bench):
    homed.rail.move_to(0.03).wait(10.0)
    motion = homed.rail.move_to(0.0, speed=0.01)
    homed.clock.sleep(1.0)
    homed.peer.fault("rail.reset")
    with pytest.raises(DeviceFault, match="Home the rail again") as caught:
        motion.wait(20.0)
    assert caught.value.code == "rail.reset"
    assert caught.value.recoverable


def test_a_reset_in_the_search_does_not_end_it_well(bench: Bench):
    motion = bench.rail.home()
    bench.clock.sleep(0.2)
    bench.peer.fault("rail.reset")
    with pytest.raises(DeviceFault) as caught:
        motion.wait(20.0)
    assert caught.value.code == "rail.reset"
    assert not bench.rail.state().homed


def test_homing_after_a_reset_sets_the_module_up_again(homed: Bench):
    homed.peer.fault("rail.reset")
    homed.rail.home().wait(20.0)
    homed.rail.move_to(0.02).wait(10.0)
    assert (homed.carriage(), homed.model.settings.search_mode) == (pytest.approx(0.02, abs=1e-6), 5)
    assert homed.model.settings.max_acceleration == round(ACCELERATION * 200 * 256 / 0.002)


def test_a_target_changed_by_another_is_not_reported_as_arrival(homed: Bench):
    motion = homed.rail.move_to(0.05, speed=0.02)
    homed.model.move_to(homed.world.now(), 1000)
    with pytest.raises(DeviceFault, match="changed the module's target"):
        motion.wait(20.0)


@pytest.mark.parametrize("refused", [(), (15,), (16,)])
def test_the_ramp_is_a_trapezium_also_where_its_first_acceleration_may_not_be_zero(
    module: Callable[..., str], refused: tuple[int, ...]
):
    """Of 15, 16 and 19 one is the first acceleration, two are speeds, and modules differ in which."""
    settings = {255: 0}  # speeds in units of its own

    def answer(request: bytes) -> bytes:
        wrong = request[1] == 5 and request[2] in refused and not any(request[4:8])
        return reply(request, status=4 if wrong else 100)

    connect(module(answer, settings), Clock()).close()
    wanted = round(ACCELERATION * 200 * 256 / 0.002)
    first = {kind: wanted if kind in refused else 0 for kind in (15, 16, 19)}
    ramp = {5: wanted, 17: wanted, 18: wanted, **first, 20: 10, 255: 1}
    assert {kind: settings[kind] for kind in ramp} == ramp


@pytest.mark.parametrize("parameter", [5, 17, 140, 193])
def test_a_setting_that_the_module_does_not_take_is_a_fault_with_both_values(
    module: Callable[..., str], parameter: int
):
    with pytest.raises(DeviceFault, match=rf"keeps 3 for axis parameter {parameter} instead of \d+") as met:
        connect(module(reply, {255: 1, parameter: 3}, (parameter,)), Clock())
    assert met.value.code == "rail.setting"


@pytest.mark.parametrize("model", [b"1110V109", b"1140V145", b"0012V102", b"hello   "])
def test_a_module_that_counts_in_other_units_or_is_none_is_refused_before_anything_is_set(
    module: Callable[..., str], model: bytes
):
    settings: dict[int, int] = {}
    with pytest.raises(ConfigError, match=r"TMCM-1260.*nothing was set"):
        connect(module(lambda request: b"\x02" + model, settings), Clock())
    assert settings == {}


def test_a_module_that_lets_neither_first_phase_be_off_gets_no_acceleration_for_a_speed(module: Callable[..., str]):
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


def test_a_zero_that_was_lost_is_not_trusted_though_the_module_cannot_be_told(module: Callable[..., str]):
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


def test_a_module_set_to_other_microsteps_is_not_homed_any_more_and_who_only_looks_leaves_it_so(homed: Bench):
    homed.rail.close()
    homed.peer.module.handle(telegram(5, 140, 7))
    looking = connect(homed.peer.url, homed.clock, control=False)
    assert not looking.state().homed
    looking.close()
    assert homed.model.settings.microsteps == 7
    require_not_homed(homed)


@pytest.mark.parametrize("off", [1, -1, 2])
def test_a_module_that_stands_one_count_off_its_target_has_arrived(homed: Bench, monkeypatch, off: int):
    counted = homed.model.position
    monkeypatch.setattr(homed.model, "position", lambda t: counted(t) + off)
    motion = homed.rail.move_to(0.01)
    if abs(off) == 1:
        motion.wait(10.0)
        assert homed.rail.state().position == pytest.approx(0.01, abs=1e-7)
    else:
        with pytest.raises(DeviceFault, match=r"its target is|has not ended"):
            motion.wait(10.0)
