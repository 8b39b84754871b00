"""The rail's driver against a module that nobody of this project's simulator has written."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import pytest

from drivers.clock import Clock
from drivers.errors import ConfigError, DeadlineError, DeviceFault
from drivers.rail.tmcl.rail import TmclRail
from tests.support.wire import rail_bench
from tests.support.wire.other_module import NAMES, Order, OtherModule

pytestmark = pytest.mark.wire
ACCELERATION, SPEED = 1.0, 0.05
COUNTS = 200 * 256 / 0.01


def connect(module: OtherModule, address: int = 1) -> TmclRail:
    return rail_bench.connect(
        module.url, Clock(), lead=0.01, travel=(-0.001, 0.05), max_speed=0.2, acceleration=ACCELERATION, address=address
    )


@pytest.fixture
def module() -> Iterator[OtherModule]:
    module = OtherModule()
    yield module
    module.close()


@pytest.fixture
def rail(module: OtherModule) -> Iterator[TmclRail]:
    rail = connect(module)
    rail.home().wait(10.0)
    yield rail
    rail.close()


def sweep(rail: TmclRail) -> tuple[float, float]:
    rail.move_to(rail.sweep_start(0.01, 0.035, SPEED)).wait(10.0)
    sweep = rail.sweep(0.01, 0.035, SPEED)
    sweep.wait(10.0)
    return sweep.window


@pytest.mark.parametrize("order", ["library", "sheet"])
def test_the_ramp_is_a_trapezium_whichever_order_its_parameters_have(order: Order) -> None:
    with closing(OtherModule(order)) as module:
        rail = connect(module)
        wanted = round(ACCELERATION * COUNTS)
        assert module.axis[5] == module.ramp("DMAX") == module.ramp("D1") == wanted
        assert module.ramp("V1") == module.ramp("VSTART") == 0
        rail.home().wait(10.0)
        begin, end = sweep(rail)
        assert end - begin == pytest.approx(0.025 / SPEED, rel=0.01)
        rail.close()


def test_a_first_acceleration_that_may_not_be_zero_is_set_to_the_acceleration(module: OtherModule) -> None:
    module.refused = {(NAMES["library"]["A1"], 0)}
    connect(module).close()
    assert (module.ramp("A1"), module.ramp("V1")) == (round(ACCELERATION * COUNTS), 0)


@pytest.mark.parametrize("parameter", [5, 17, 140, 193])
def test_a_setting_that_the_module_does_not_take_is_a_fault_with_both_values(
    module: OtherModule, parameter: int
) -> None:
    module.stubborn = {parameter}
    module.axis[140] = 6
    with pytest.raises(DeviceFault, match=rf"keeps {module.axis[parameter]} for axis parameter {parameter} ") as met:
        connect(module)
    assert met.value.code == "rail.setting"


def test_speeds_in_a_modules_own_units_are_switched_to_pulses(module: OtherModule) -> None:
    module.axis[255] = 0
    connect(module).close()
    assert module.axis[255] == 1


def test_a_sweep_that_brakes_inside_its_window_is_refused_with_how_far_it_was_off(
    module: OtherModule, rail: TmclRail
) -> None:
    sweep(rail)
    module.axis[17] //= 4  # somebody else sets the module up
    with pytest.raises(DeviceFault, match=r"up to \d\.\d{3} mm off every even motion.*allowed 0\.050 mm") as met:
        sweep(rail)
    assert met.value.code == "rail.uneven"


@pytest.mark.parametrize("model", ["1110V109", "1140V145", "0012V102", "hello   "])
def test_a_module_that_counts_in_other_units_or_is_none_is_refused_before_anything_is_set(
    module: OtherModule, model: str
) -> None:
    module.firmware = model
    before = dict(module.axis)
    with pytest.raises(ConfigError, match=r"TMCM-1260.*nothing was set"):
        connect(module)
    assert module.axis == before


def test_an_adapter_that_hears_itself_is_understood(module: OtherModule) -> None:
    module.echo = True
    rail = connect(module)
    rail.home().wait(10.0)
    sweep(rail)
    assert rail.statistics.errors == {"echoes": rail.statistics.errors["echoes"]}
    rail.close()
    module.silent = True
    with pytest.raises(DeadlineError, match="0 of 9 bytes came after the adapter's echo"):
        connect(module)


@pytest.mark.parametrize("trouble", ["half", "bent", "foreign", "doubted"])
def test_a_spoilt_reply_is_asked_for_once_more(module: OtherModule, rail: TmclRail, trouble: str) -> None:
    motion = rail.move_to(0.02)
    setattr(module, trouble, 1)
    motion.wait(10.0)
    assert (rail.state().position, rail.statistics.errors["retries"]) == (pytest.approx(0.02, abs=1e-6), 1)


def test_nobody_at_the_address_is_told_with_address_and_baud_rate(module: OtherModule) -> None:
    with pytest.raises(DeadlineError, match=r"module address 3 \(rail\.address\), rail\.baud \(9600"):
        connect(module, address=3)
