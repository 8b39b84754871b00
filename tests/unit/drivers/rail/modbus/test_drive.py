"""Promises of `drivers.rail.modbus.drive`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from drivers.errors import Aborted, DeviceFault, InterlockError
from sim_backends.models.rail import RailModel
from tests.support.modbus_maps import EDGES, PATHS
from tests.support.wire.modbus_bench import Drive, config

pytestmark = pytest.mark.wire


def test_numbers_whose_words_come_in_the_other_order_end_the_first_motion_at_its_first_reading(drive: Drive):
    """Whatever is written reads back, 0 is 0 in either order, and the drive runs off the other way."""
    other = replace(drive, record=config({**PATHS, "word_order": "low first"}))
    rail = other.homed()
    with pytest.raises(DeviceFault, match="word_order") as told:
        rail.move_to(0.0123, 0.015).wait(30.0)
    assert told.value.code == "rail.astray"
    drive.clock.sleep(0.5)
    assert abs(drive.model.carriage(drive.clock.now())) < 3e-3
    with pytest.raises(InterlockError, match="homed"):
        rail.move_to(0.0123, 0.015)
    rail.close()


def test_a_drive_that_takes_its_speed_in_another_unit_is_told_as_too_fast(drive: Drive):
    """30 rpm for the configuration, in tenths: written as 300, taken by the drive as 300 rpm."""
    other = replace(drive, record=config({**PATHS, "speed": {"address": 0x6203, "unit": "0.1 rpm"}}))
    rail = other.homed()
    with pytest.raises(DeviceFault, match="in which unit") as told:
        rail.move_to(0.0050, 0.001).wait(30.0)
    assert told.value.code == "rail.too_fast"
    rail.close()


def test_a_zero_that_another_program_found_is_not_this_ones(drive: Drive):
    drive.homed().close()
    rail = drive.rail()
    assert (rail.state().homed, rail.state().homed_here) == (True, False)
    # Homed before it began: that the flag stands is no news. It has to be seen to search.
    rail.move_to(0.05).wait(60.0)
    rail.home().wait(60.0)
    assert rail.state().homed_here
    assert rail.state().position == pytest.approx(0.0, abs=1e-4)
    rail.close()


def test_a_search_at_the_drives_own_speed_is_slower_than_the_rail_may_go(drive: Drive):
    rail = drive.homed()
    rail.move_to(0.095).wait(60.0)
    rail.close()
    drive.homed(max_speed=2.0).close()


def test_a_drive_that_does_not_begin_to_search_is_not_homed(drive: Drive):
    drive.homed().close()
    deaf = config({**PATHS, "home": {"address": 0x6002, "value": 0x77}})
    rail = drive.rail(registers=deaf.registers)
    with pytest.raises(DeviceFault, match=r"rail\.not_begun"):
        rail.home().wait(60.0)
    assert not rail.state().homed_here
    rail.close()


@contextmanager
def shown(model: RailModel, name: str, told: Callable[[float], Any]) -> Iterator[None]:
    """The drive shows this instead of what is so."""
    setattr(model, name, told)
    try:
        yield
    finally:
        delattr(model, name)


@pytest.fixture
def edges() -> Iterator[Drive]:
    """The drive whose map has the switches."""
    made = Drive.of(config(EDGES))
    yield made
    made.peer.stop()


def test_what_speaks_against_a_zero_when_nobody_watched_ends_the_trust_in_it(edges: Drive):
    drive = edges
    drive.homed().close()
    for name in ("stalled", "left_switch", "right_switch"):
        with shown(drive.model, name, lambda t: True):
            rail = drive.rail()
        assert drive.peer.drive._homed
        assert not rail.state().homed, name
        with pytest.raises(InterlockError, match="not homed"):
            rail.move_to(0.01)
        rail.close()
    rail = drive.rail()
    assert rail.state().homed
    rail.close()


def test_a_search_that_ends_elsewhere_in_an_alarm_or_by_a_stop_finds_no_zero(edges: Drive):
    drive, rail = edges, edges.rail()
    true, off = drive.model.position, round(0.002 / drive.record.lead * drive.record.counts_per_turn)
    with shown(drive.model, "position", lambda t: true(t) + off):
        with pytest.raises(DeviceFault, match=r"counts 2 mm there .*rail\.setting"):
            rail.home().wait(60.0)
        assert not rail.state().homed_here
    search = rail.home()
    with shown(drive.model, "stalled", lambda t: True), pytest.raises(DeviceFault, match=r"while it searched"):
        search.wait(60.0)
    search = rail.home()
    rail.stop()
    with pytest.raises(Aborted):
        search.wait(60.0)
    assert not rail.state().homed
    rail.close()


def test_an_obstacle_is_an_alarm_with_its_number():
    drive = Drive.of(config(PATHS, travel=["0 mm", "120 mm"]))
    rail = drive.homed()
    drive.model.configure(drive.clock.now(), replace(drive.model.settings, right_stop=False))
    with pytest.raises(DeviceFault, match="alarm 0x00e0") as met:
        rail.move_to(0.115).wait(60.0)
    assert met.value.code == "rail.alarm"
    assert not rail.state().homed
    with pytest.raises(InterlockError):
        rail.move_to(0.01)
    assert [reading.ok for reading in rail.examine(0.0)] == [False]
    # Cleared at the drive, which says that it is homed as before: it may have slipped.
    drive.model.clear_stall()
    assert drive.peer.drive._homed
    assert not rail.state().homed
    rail.close()
    drive.peer.stop()
