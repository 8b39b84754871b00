"""A part in its nest is looked at, with the nest's own tolerances."""

from __future__ import annotations

from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.procedures.steps.verify_nest import where_seen
from lab.bench.job.whole_job import JobRecord
from tests.support.lying_part import creeps, moved
from tests.support.unloading import JOB, unloaded


def test_a_part_that_comes_to_lie_beside_its_nest_is_misplaced(placed_pot: JobRecord) -> None:
    def slips(cell: VirtualCell) -> None:
        cell.world.part.opening[1, 3] = 1.8e-3

    done = unloaded(placed_pot, slips)
    assert (done.outcome, done.stage) == ("misplaced", "verify")
    assert "in axes of the arm base" in done.reason and "the part is already down" in done.reason


def test_a_part_that_creeps_in_its_nest_is_misplaced(placed_pot: JobRecord) -> None:
    done = unloaded(placed_pot, lambda cell: creeps(cell, moved(y=0.06e-3), nested=True))
    assert (done.outcome, done.stage) == ("misplaced", "verify") and "does not lie still" in done.reason


def test_the_place_where_a_part_is_looked_at_is_its_own_or_the_nest() -> None:
    pot, _ = load_job("pot")
    assert where_seen(pot) is pot
    assert JOB.nest is not None
    place = where_seen(JOB).place
    assert place.surface_from_part.translation == (-0.6, 0.06, 0.03)
    assert (place.tolerance, place.tolerance_angle) == (JOB.nest.tolerance, JOB.nest.tolerance_angle)
    assert place.approach == JOB.place.approach
