"""What stands on the place is seen in the scan, and refused before the part is put onto it."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_parts
from cell.measure.inversion.obstruction import Standing, highest_standing, require_bare
from cell.measure.reconstruction import Cloud
from cell.procedures.steps.kinds import PLACE
from cell.procedures.steps.place import STEP
from drivers.errors import RefusedError
from lab.bench.job.whole_job import JobRecord, NoFrames
from statemachine.runner import StepContext
from tests.support.report_runs import CONFIG, at_station, pot, work_of


def with_chip(
    record: JobRecord, height: float, radius: float = 1.5e-3, at: tuple[float, float] = (0.012, 0.005)
) -> Cloud:
    """The cloud of `record` as if a round chip lay on the surface, m."""
    cloud, pose = record.results["reconstruct"].cloud, record.results["invert_pose"].base_from_surface
    local = (cloud.points - pose.translation) @ pose.rotation
    on_chip = np.hypot(local[..., 0] - at[0], local[..., 1] - at[1]) < radius
    return replace(cloud, points=cloud.points + np.where(on_chip[..., None], height * pose.rotation[:, 2], 0.0))


def standing(record: JobRecord, cloud: Cloud, aside: float = 0.0) -> Standing | None:
    """What stands highest below the part, put down so many metres aside."""
    job, nominal = pot()
    pose = record.results["invert_pose"].base_from_surface
    return highest_standing(cloud, nominal, pose, from_parts((aside, 0.0, 0.0)), job.grasp.size)


def test_nothing_stands_on_a_surface_that_is_as_drawn(placed_pot: JobRecord) -> None:
    found = standing(placed_pot, placed_pot.results["reconstruct"].cloud)
    assert found is not None and found.height < 0.1e-3
    require_bare(found, pot()[0].place.tolerance)


@pytest.mark.parametrize(
    ("height", "at"), [(0.45e-3, (0.012, 0.005)), (1e-3, (-0.0153, -0.0041)), (2e-3, (0.0206, -0.0107))]
)
def test_a_chip_of_three_millimetres_is_seen_as_high_as_it_is(
    placed_pot: JobRecord, height: float, at: tuple[float, float]
) -> None:
    found = standing(placed_pot, with_chip(placed_pot, height, at=at))
    assert found is not None and found.height == pytest.approx(height, abs=0.12e-3)
    assert np.hypot(*(found.at[:2] - at)) < 1.5e-3
    with pytest.raises(RefusedError, match=r"something stands (\d\.\d\d) mm out of the surface") as refused:
        require_bare(found, pot()[0].place.tolerance)
    (number,) = refused.value.numbers
    assert number.value > number.most == pytest.approx(0.3)


def test_what_lies_beside_the_part_or_below_the_surface_does_not_lift_it(placed_pot: JobRecord) -> None:
    beside = standing(placed_pot, with_chip(placed_pot, 1e-3), aside=-0.03)
    hollow = standing(placed_pot, with_chip(placed_pot, -1e-3))
    for found in (beside, hollow):
        assert found is not None and found.height < 0.1e-3


def test_the_job_ends_before_anything_moves(placed_pot: JobRecord, tmp_path: Path) -> None:
    job, nominal = pot()
    cell = VirtualCell(CONFIG, placed_pot.seed, placed_pot.level)
    at_station(cell, placed_pot)
    work = work_of(cell, job, nominal, placed_pot, NoFrames(), tmp_path)
    made = {name: result for name, result in placed_pot.results.items() if name != "place"}
    made["reconstruct"] = replace(made["reconstruct"], cloud=with_chip(placed_pot, 1e-3))
    context = StepContext(PLACE.policy().of("place"), 1, math.inf, made, cell.clock, lambda event: None)
    before = cell.clock.now()
    with pytest.raises(RefusedError, match="Look what it is") as refused:
        STEP.work(work, context)
    assert re.search(r"at \(1[123], [456], \d+\) mm", str(refused.value))
    assert cell.clock.now() == before and cell.world.part.held
