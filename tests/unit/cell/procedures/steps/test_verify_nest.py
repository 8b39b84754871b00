"""A part in its nest is looked at, with the nest's own tolerances."""

from collections.abc import Callable
from pathlib import Path

import pinocchio as pin
import pytest

from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_matrix
from cell.procedures.arm.moves import PartState
from cell.procedures.steps.verify_nest import where_seen
from drivers.errors import MisplacedError
from lab.bench.job.whole_job import JobRecord
from tests.support.lying_part import creeps, moved
from tests.support.unloading import JOB, where_unloaded


def misplaced(
    record: JobRecord, folder: Path, off: pin.SE3, changed: Callable[[VirtualCell], None] = lambda cell: None
) -> str:
    """Why a part that lies `off` where `record` set it down is misplaced, in a cell that is `changed`."""
    site = where_unloaded(record, folder)
    lies = from_matrix(record.at_end["poses"]["base_from_part"]) * off
    site.cell.world.part._base_from_part = lies.homogeneous
    site.work.part.state, site.work.part.where = PartState.RELEASED, lies
    site.work.mover.avoid_part(lies, JOB.grasp.size)
    changed(site.cell)
    with pytest.raises(MisplacedError) as told:
        site.do("verify")
    return str(told.value)


def test_a_part_that_comes_to_lie_beside_its_nest_is_misplaced(unloaded_part: JobRecord, tmp_path):
    told = misplaced(unloaded_part, tmp_path, moved(y=1.8e-3))
    assert "in axes of the arm base" in told and "mm off" in told


def test_a_part_that_creeps_in_its_nest_is_misplaced(unloaded_part: JobRecord, tmp_path):
    told = misplaced(unloaded_part, tmp_path, moved(), lambda cell: creeps(cell, moved(y=0.06e-3)))
    assert "does not lie still" in told


def test_the_place_where_a_part_is_looked_at_is_its_own_or_the_nest():
    pot, _ = load_job("pot")
    assert where_seen(pot) is pot
    assert JOB.nest is not None
    place = where_seen(JOB).place
    assert place.surface_from_part.translation == (-0.6, 0.06, 0.03)
    assert (place.tolerance, place.tolerance_angle) == (JOB.nest.tolerance, JOB.nest.tolerance_angle)
    assert place.approach == JOB.place.approach
