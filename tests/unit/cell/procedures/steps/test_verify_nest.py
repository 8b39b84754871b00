"""A part in its nest is looked at, with the nest's own tolerances."""

from __future__ import annotations

import numpy as np

from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.procedures.steps.verify_nest import where_seen
from lab.bench.job.whole_job import JobRecord
from tests.support.unloading import JOB, unloaded


def test_a_part_that_comes_to_lie_beside_its_nest_is_misplaced(placed_pot: JobRecord) -> None:
    def slips(cell: VirtualCell) -> None:
        cell.world.part.opening[1, 3] = 1.8e-3

    done = unloaded(placed_pot, slips)
    assert (done.outcome, done.stage) == ("misplaced", "verify")
    assert "in axes of the arm base" in done.reason and "the part is already down" in done.reason


def test_a_part_that_creeps_in_its_nest_is_misplaced(placed_pot: JobRecord) -> None:
    def slides(cell: VirtualCell) -> None:
        part, stands, began = cell.world.part, cell.world.part._pose, list[float]()

        def pose(flange: np.ndarray) -> np.ndarray:
            lies = stands(flange)
            if part._base_from_part is not None and not part.held:
                began.append(cell.clock.now())
                lies[1, 3] += 0.06e-3 * (began[-1] - began[0])
            return lies

        part._pose = pose

    done = unloaded(placed_pot, slides)
    assert (done.outcome, done.stage) == ("misplaced", "verify") and "does not lie still" in done.reason


def test_the_place_where_a_part_is_looked_at_is_its_own_or_the_nest() -> None:
    pot, _ = load_job("pot")
    assert where_seen(pot) is pot
    assert JOB.nest is not None
    place = where_seen(JOB).place
    assert place.surface_from_part.translation == (-0.6, 0.06, 0.03)
    assert (place.tolerance, place.tolerance_angle) == (JOB.nest.tolerance, JOB.nest.tolerance_angle)
    assert place.approach == JOB.place.approach
