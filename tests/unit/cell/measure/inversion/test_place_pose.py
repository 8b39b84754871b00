"""What neighbouring points are off by together is found from the scan, and stated where few patches tell a motion."""

import numpy as np
import pytest
from numpy.typing import NDArray

from cell.measure.geometry.poses import difference, perturbed
from cell.measure.inversion import Prior, Tolerance, invert_pose
from cell.measure.inversion.nominal import SIGMA_FLOOR, Scan
from cell.measure.inversion.place_pose import PATCH_M, shared_by_patches
from cell.measure.inversion.registration import register
from cell.measure.reconstruction.cloud import Cloud
from drivers.errors import RefusedError
from tests.unit.cell.measure.inversion.test_registration import (
    BOARD,
    JOB,
    TRUE,
    Height,
    freeform,
    ledges,
    nominal,
    scanned,
)  # fmt: skip

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
def test_a_pattern_that_the_board_does_not_place_is_refused_with_its_pitch(off: float):
    with pytest.raises(RefusedError, match=r"looks the same elsewhere: shifted by \(-?5\.0, ") as refused:
        invert_pose(scanned(waves, 1), nominal(waves), board(0.002, off=off), JOB)
    assert "surface.prior_sigma" in str(refused.value)
    assert refused.value.numbers[0].least == 5.0


def test_the_same_pattern_is_found_where_the_board_knows_better():
    found = invert_pose(scanned(waves, 2), nominal(waves), board(0.0005, off=0.0004), JOB)
    assert np.linalg.norm(found.base_from_surface.translation - TRUE.translation) < 1e-4


@pytest.mark.parametrize("height", [waves_with_an_end, freeform])
def test_what_comes_once_only_tells_the_place(height: Height):
    found = invert_pose(scanned(height, 3), nominal(height), board(0.002, off=0.0015), JOB)
    assert np.linalg.norm(found.base_from_surface.translation - TRUE.translation) < 1e-4


FORM = np.random.default_rng(5).standard_normal((40, 40))


def uneven(size: float) -> Cloud:
    """Two ledges on a plane of which each patch of 4 mm is off along its normal, 1 σ of `size` m, as a stripe or a
    casting is: the ledges, with 2 % of the points, tell the shifts along x and y, and the turn."""

    def height(x: Array, y: Array) -> Array:
        i, j = (np.clip(np.floor(v / PATCH_M).astype(int) + 20, 0, 39) for v in (x, y))
        slope_x = (ledges(x + 1e-6, y) - ledges(x - 1e-6, y)) / 2e-6
        slope_y = (ledges(x, y + 1e-6) - ledges(x, y - 1e-6)) / 2e-6
        return ledges(x, y) + size * FORM[i, j] * np.sqrt(1 + slope_x**2 + slope_y**2)

    return scanned(height, 4)


@pytest.mark.parametrize("size", [0.0, 15e-6])
def test_what_a_patch_shares_is_found_and_counts_for_what_few_patches_tell(size: float):
    found = register(Scan.of(uneven(size)), nominal(ledges), Prior(TRUE, BOARD))
    sigma, by_patches = shared_by_patches(found)
    assert sigma == pytest.approx(size, rel=0.25, abs=2 * SIGMA_FLOOR)
    shared, random = (np.sqrt(np.diag(matrix)) for matrix in (by_patches, found.covariance))
    if not size:
        # Nothing to speak of where there is nothing: 3 µm of facets.
        assert (shared < 1.2 * random).all()
        # A placed part is believed to a third of that.
        assert np.allclose(shared_by_patches(found, SIGMA_FLOOR / 3)[1], by_patches / 9, atol=0.0)
        return
    assert shared_by_patches(found, SIGMA_FLOOR / 3)[0] == sigma, "what there is counts"
    # The nine patches along a ledge tell the way across it no better than their mean.
    assert shared[0] == pytest.approx(size / np.sqrt(9), rel=0.5)
    assert shared[5] > 2.0 * random[5]
    # What the whole plane tells averages out.
    assert shared[2] < 3e-6


def test_the_stated_deviation_holds_where_neighbours_err_together(monkeypatch):
    # Believed to the last point: the rule that leaves what few points tell to the board is another one.
    monkeypatch.setattr("cell.measure.inversion.observability.FEW", 0.0)
    found = invert_pose(uneven(15e-6), nominal(ledges), Prior(TRUE, BOARD), JOB)
    off = difference(found.base_from_surface, TRUE)
    assert (np.abs(off) < 3.0 * found.sigma).all()
    # The turn that the ledges tell: three times as much as the points' own noise leaves of it.
    assert found.sigma[5] > 2.0 * np.sqrt(found.random[5, 5])


def test_what_the_arm_is_off_by_counts_where_the_board_decides_as_well():
    def ridge(x: Array, y: Array) -> Array:
        return 0.006 * np.exp(-((y / 0.006) ** 2))

    prior, arm = Prior(TRUE, np.diag([5e-5**2] * 3 + [1e-3**2] * 3)), np.diag([0.5e-3**2] * 3 + [0.0] * 3)
    found = invert_pose(scanned(ridge, 1), nominal(ridge), prior, Tolerance(5e-3, 5e-2), systematic=arm)
    assert found.verdict.unseen
    assert (found.sigma[:3] > 0.5e-3).all()
