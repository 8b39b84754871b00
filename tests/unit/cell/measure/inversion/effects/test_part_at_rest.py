"""By how much a part moved between two clouds of it, against the motion that was put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cell.measure.inversion.effects.between_sweeps import GATE_M
from cell.measure.inversion.effects.part_at_rest import LEAST_M, PartOnGround
from cell.measure.reconstruction.cloud import Cloud
from lab.bench.job.whole_job import JobRecord
from tests.support.report_runs import pot

KNOWN = np.diag([1e-6**2] * 6)


def lying(record: JobRecord) -> tuple[PartOnGround, Cloud]:
    """The surface of a job in the place of a part, and its cloud."""
    return PartOnGround(pot()[1], record.results["invert_pose"].base_from_surface), record.results["reconstruct"].cloud


def every_fourth(cloud: Cloud, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Cloud:
    """A cloud of the other lines, moved."""
    points = np.full_like(cloud.points, np.nan)
    points[2::4] = cloud.points[2::4] + np.array(shift)
    return replace(cloud, points=points)


@pytest.mark.parametrize("shift", [(0.0, 0.06e-3, 0.0), (0.05e-3, -0.05e-3, 0.02e-3), (0.0, 0.0, -0.06e-3)])
def test_a_motion_comes_out_as_it_was_put_in(placed_pot: JobRecord, shift: tuple[float, float, float]) -> None:
    part, cloud = lying(placed_pot)
    found = part.moved(cloud, every_fourth(cloud, shift), KNOWN)
    assert found == pytest.approx(np.linalg.norm(shift), abs=0.01e-3)
    assert part.moved(cloud, every_fourth(cloud), KNOWN) is None
    # What the sweeps may lie apart for another reason is no motion of the part.
    assert part.moved(cloud, every_fourth(cloud, shift), np.diag([0.1e-3**2] * 6)) is None


def test_less_than_matters_or_a_part_that_does_not_show_is_none_and_one_far_off_the_gate(placed_pot: JobRecord) -> None:
    part, cloud = lying(placed_pot)
    nothing = every_fourth(replace(cloud, points=np.full_like(cloud.points, np.nan)))
    assert part.moved(cloud, every_fourth(cloud, (0.0, 0.0, 0.9 * LEAST_M)), KNOWN) is None
    assert part.moved(nothing, every_fourth(cloud), KNOWN) is None
    assert part.moved(cloud, nothing, KNOWN) == part.moved(cloud, every_fourth(cloud, (0, 0, 9e-3)), KNOWN) == GATE_M
