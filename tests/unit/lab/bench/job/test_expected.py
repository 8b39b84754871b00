"""What contact makes of the expected placement: the ground decides how far down, the cell's errors all else."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pinocchio as pin
import pytest

from cell.config.job import load_job
from cell.measure.inversion import NominalSurface
from lab.bench.job.expected import mean_after_contact

JOB, MESH = load_job("pot")
NOMINAL = NominalSurface.load(MESH, unit=JOB.surface.mesh_unit)
POSE = cast(Any, SimpleNamespace(base_from_surface=pin.SE3(np.eye(3), np.array([0.7, 0.6, 0.05]))))


def test_an_error_of_height_is_gone_after_contact():
    assert mean_after_contact(np.diag([0, 0, 1e-4**2, 0, 0, 0]), NOMINAL, POSE) < 1e-9


def test_an_error_to_the_side_stays_and_lifts_the_part_onto_a_slope():
    sigma = 1e-4
    found = mean_after_contact(np.diag([sigma**2, 0, 0, 0, 0, 0]), NOMINAL, POSE)
    # To the side alone it would be the mean of |x|, √(2/π) σ; a curved surface can only lift the part.
    assert found > np.sqrt(2 / np.pi) * sigma * 0.95 and found < 1.5 * sigma


def test_a_turn_about_the_way_down_is_left_as_it_is():
    flat = NominalSurface(
        np.array([[-0.03, -0.02, 0.0], [0.03, -0.02, 0.0], [0.03, 0.02, 0.0], [-0.03, 0.02, 0.0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    found = mean_after_contact(np.diag([0, 0, 0, 0, 0, 1e-3**2]), flat, POSE)
    assert found == pytest.approx(np.sqrt(2 / np.pi) * 1e-3 * 0.0187, rel=0.1)
