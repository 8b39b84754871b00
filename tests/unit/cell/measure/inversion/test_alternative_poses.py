"""A surface that fits its scan at another place as well is refused by the run, unless the board tells the two apart."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cell.measure.geometry.poses import perturbed
from cell.measure.inversion import Prior, invert_pose
from drivers.errors import RefusedError
from tests.unit.cell.measure.inversion.test_registration import JOB, TRUE, freeform, nominal, scanned

Array = NDArray[np.float64]
PITCH = 0.005


def waves(x: Array, y: Array) -> Array:
    """Every 5 mm along x the same, m."""
    return 0.006 + 0.0008 * np.cos(2 * np.pi * x / PITCH) + 0.001 * np.sin(230 * y + 0.4)


def waves_with_an_end(x: Array, y: Array) -> Array:
    """One of the waves is another one, m."""
    return waves(x, y) + 0.0015 * np.exp(-((x - 0.011) ** 2 + (y - 0.004) ** 2) / 0.004**2)


def board(sigma: float, off: float = 0.0) -> Prior:
    spread = np.diag([sigma**2] * 3 + [0.005**2] * 3)
    return Prior(perturbed(TRUE, np.array([off, 0.0, 0.0, 0.0, 0.0, 0.0])), spread)


@pytest.mark.parametrize("off", [0.003, 0.0], ids=["nearer to the other", "nearer to this one"])
def test_a_pattern_that_the_board_does_not_place_is_refused_with_its_pitch(off: float) -> None:
    with pytest.raises(RefusedError, match=r"looks the same elsewhere: shifted by \(-?5\.0, ") as refused:
        invert_pose(scanned(waves, 1), nominal(waves), board(0.002, off=off), JOB)
    assert "surface.prior_sigma" in str(refused.value)
    assert refused.value.numbers[0].least == 5.0


def test_the_same_pattern_is_found_where_the_board_knows_better() -> None:
    found = invert_pose(scanned(waves, 2), nominal(waves), board(0.0005, off=0.0004), JOB)
    assert np.linalg.norm(found.base_from_surface.translation - TRUE.translation) < 1e-4


@pytest.mark.parametrize("height", [waves_with_an_end, freeform])
def test_what_comes_once_only_tells_the_place(height: object) -> None:
    assert callable(height)
    found = invert_pose(scanned(height, 3), nominal(height), board(0.002, off=0.0015), JOB)
    assert np.linalg.norm(found.base_from_surface.translation - TRUE.translation) < 1e-4
