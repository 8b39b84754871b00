"""Flush along the edge of a placed part, against closed forms; that of a part in the world is tested at `verify`."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_parts
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.flush import BESIDE_M, Flush, flush_along_edge
from cell.measure.reconstruction import Cloud
from tests.unit.cell.measure.inversion.test_registration import TRUE, scanned

Array = NDArray[np.float64]
HALF, THICK = 0.020, 0.010
BELONGS = from_parts((0.0, 0.0, THICK))


def plate(half_x: float, half_y: float) -> NominalSurface:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [half_x, half_y, 0.0]
    return NominalSurface(corners, [[0, 1, 2], [0, 2, 3]])


SURFACE, TOP = plate(0.035, 0.018), plate(HALF, 0.018)


def swept(part: Array | float, beside: Array | float = 0.0) -> Cloud:
    """A part of 10 mm on the middle of a plate; each is higher than drawn by a number, or (offset, slope along y)."""

    def height(x: Array, y: Array) -> Array:
        own, other = (np.polyval(np.atleast_1d(lift)[::-1], y) for lift in (part, beside))
        return np.where(np.abs(x) < HALF, THICK + own, other)

    return scanned(height, 5)


def flush(cloud: Cloud, pose: pin.SE3 = TRUE) -> Flush:
    found = flush_along_edge(cloud, pose, SURFACE, TOP, BELONGS)
    assert found is not None
    return found


def test_a_part_that_stands_as_drawn_is_flush_within_its_noise() -> None:
    found = flush(swept(0.0))
    assert (np.abs(found.higher) < found.noise).all() and np.median(found.noise) < 0.15e-3
    assert found.beyond < 0.0
    # Both ends have some of the surface beside them; the sides have none, and the middle is no edge.
    x = np.abs(found.places[:, 0])
    assert x.min() > 0.013 and x.max() < HALF and len(found.higher) > 40
    assert HALF - x.min() < BESIDE_M


def test_each_piece_is_held_against_what_lies_beside_it() -> None:
    """The part is bent, 5 µm a mm along its edge; the surface is .1 mm lower beside it."""
    found = flush(swept(np.array([0.2e-3, 5e-3]), -0.1e-3))
    assert np.allclose(found.higher, 0.3e-3 + 5e-3 * found.places[:, 1], atol=0.03e-3)
    worst = np.abs(found.higher) - found.noise
    assert found.beyond == pytest.approx(1e3 * worst.max())
    assert found.as_dict() == {
        "least_mm": pytest.approx(0.22, abs=0.03), "median_mm": pytest.approx(0.3, abs=0.03),
        "largest_mm": pytest.approx(0.38, abs=0.03), "pieces": len(found.higher),
    }  # fmt: skip
    assert re.fullmatch(r"\+0\.2\d to \+0\.[34]\d", found.span)


def test_where_the_sweep_shows_both_moved_alike_nothing_is_seen_of_it() -> None:
    """The arm's rest moves part and surface, so the surface is found beside its pose."""
    moved = TRUE * from_parts((0.1e-3, -0.2e-3, 0.3e-3))
    found = flush(swept(0.0), moved)
    assert np.abs(found.higher).max() < 0.06e-3


def test_without_the_surface_beside_the_part_there_is_no_flush() -> None:
    cloud = swept(0.0)
    alone = plate(0.5 * HALF, 0.018)
    assert flush_along_edge(cloud, TRUE, SURFACE, alone, BELONGS) is None, (
        "no point beside its edge lies on the surface"
    )
    assert flush_along_edge(cloud, TRUE * from_parts((0.0, 0.0, 0.05)), SURFACE, TOP, BELONGS) is None
    assert flush_along_edge(cloud, TRUE, plate(0.25 * HALF, 0.018), TOP, BELONGS) is None, (
        "nothing of the surface shows"
    )


def test_on_a_slope_it_is_still_the_step_along_the_surface_s_z_axis() -> None:
    """A roof of 0.5 m/m stands .4 mm too high: across the roof that is .36 mm."""
    slope = 0.5
    turn = pin.rpy.rpyToMatrix(0.0, -np.arctan(slope), 0.0)
    roof = plate(HALF * np.hypot(1.0, slope), 0.018)
    roof = NominalSurface(roof.vertices @ turn.T, roof.triangles)

    def height(x: Array, y: Array) -> Array:
        return np.where(np.abs(x) < HALF, THICK + slope * x + 0.4e-3, 0.0 * y)

    found = flush_along_edge(scanned(height, 5), TRUE, SURFACE, roof, BELONGS)
    assert found is not None and np.median(found.higher) == pytest.approx(0.4e-3, abs=0.01e-3)


def test_a_piece_whose_points_disagree_says_nothing() -> None:
    cloud = swept(0.0)
    local = (cloud.points - TRUE.translation) @ TRUE.rotation
    torn = (local[..., 0] > 0.012) & (np.abs(local[..., 0]) < HALF) & (np.abs(local[..., 1]) < 0.005)
    local[torn, 2] += np.random.default_rng(3).uniform(-2e-3, 2e-3, int(torn.sum()))
    found = flush(replace(cloud, points=local @ TRUE.rotation.T + TRUE.translation))
    assert found.beyond < 0.0 and np.abs(found.higher).max() < 0.1e-3
    assert not ((found.places[:, 0] > 0.013) & (np.abs(found.places[:, 1]) < 0.004)).any()
