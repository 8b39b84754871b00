"""The rail in this process keeps a rail's promises."""

import numpy as np
import pytest

from drivers.errors import Aborted, InterlockError


def test_a_sweep_knows_where_the_rail_was_at_any_time_of_it(cell):
    rail = cell.rail
    with pytest.raises(InterlockError):
        rail.sweep(0.02, 0.03, 0.015)
    rail.move_to(rail.sweep_start(0.02, 0.03, 0.015)).wait(30.0)
    sweep = rail.sweep(0.02, 0.03, 0.015)
    sweep.wait(30.0)
    begin, end = sweep.window
    assert end - begin == pytest.approx(0.010 / 0.015, rel=1e-3)
    for time in np.linspace(begin, end, 7)[1:-1]:
        # Answers fall anywhere in half a millisecond: 15 mm/s make 7 µm of it, and the line averages them.
        assert sweep.position_at(time) == pytest.approx(cell.world.rail.carriage(time), abs=4e-6)


def test_a_stop_of_the_rail_ends_its_motion_and_lasts_until_it_stands(cell):
    rail = cell.rail
    rail.move_to(0.010).wait(30.0)
    motion = rail.move_to(0.090)
    cell.clock.sleep(0.5)
    rail.stop()
    assert cell.world.rail.velocity(cell.clock.now()) == 0
    with pytest.raises(Aborted, match="before its target"):
        motion.wait(30.0)
    assert rail.state().homed


def test_a_search_that_was_stopped_has_found_no_zero(fresh):
    rail = fresh.rail
    search = rail.home()
    rail.clock.sleep(0.2)
    rail.stop()
    with pytest.raises(Aborted):
        search.wait(30.0)
    assert not rail.state().homed
    with pytest.raises(InterlockError, match="is not homed"):
        rail.move_to(0.02)
