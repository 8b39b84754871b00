"""Promises of a board's uncertainty: each point counts by its own σ, light that falls off moves nothing, what was moved
is dropped. Truths are closed forms and known places; no picture is drawn by the code that is tested."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.special import ndtr

from cell.measure.geometry.poses import difference
from cell.measure.vision.board.board import board_pose, without_outliers
from cell.measure.vision.board.dots import measure_dots
from cell.measure.vision.board.lattice import Blobs
from cell.measure.vision.board.view import DOTS, KINDS, BoardView
from lab.bench.board.campaign import camera_of
from lab.bench.board.conditions import LENSES, draw_pose, draw_spec
from lab.bench.board.render import Placed, true_pixels
from tests.unit.cell.measure.vision.board.drawn_boards import BRIGHT, MOST_MOVED_PX, PSF, SLOPES, uneven_picture


def drawn(kind, rng, tilt):
    """A board's true points in a picture, each with its own σ of .01 to .1 px, and its true pose."""
    spec, lens = draw_spec(kind, rng), LENSES[int(rng.integers(3))]
    placed = Placed(spec, draw_pose(spec, lens, tilt, rng, 0.7))
    pixels = true_pixels(lens, placed)
    sigma = rng.uniform(0.01, 0.1, len(pixels))
    radius = placed.radius if kind in DOTS else 0.0
    view = BoardView(spec, (lens.width, lens.height), np.arange(len(pixels)), pixels, sigma, False, radius)
    return view, camera_of(lens), pin.SE3(placed.pose)


def noisy(view, rng):
    return replace(view, pixels=view.pixels + view.sigma[:, None] * rng.normal(0, 1, view.pixels.shape))


@pytest.mark.parametrize("degrees", [5, 30, 50])
def test_the_covariance_is_true_where_points_are_not_alike(degrees):
    rng = np.random.default_rng(degrees)
    scores, whitened, turned = [], [], []
    for k in range(48):
        view, camera, truth = drawn(KINDS[k % 6], rng, np.radians(degrees))
        seen = noisy(view, rng)
        found = board_pose(seen, camera)
        error = difference(found.camera_from_board, truth)
        scores.append(error / np.sqrt(np.diag(found.covariance)))
        whitened.append(error @ np.linalg.solve(found.covariance, error))
        alike = board_pose(replace(seen, sigma=np.full(len(seen.ids), 0.05)), camera)
        turned.append([np.sum(e[3:] ** 2) for e in (difference(alike.camera_from_board, truth), error)])
    # 288 scores: one standard deviation of their RMS is .04, of one axis' .10.
    assert 0.86 < np.sqrt(np.mean(whitened) / 6) < 1.12
    assert np.sqrt(np.mean(np.square(scores), axis=0)).max() < 1.35
    # Least squares that knows the σ: half of the variance of one that treats all points alike, or less.
    equal, weighted = np.mean(turned, axis=0)
    assert weighted < 0.6 * equal


def test_residuals_that_say_more_than_the_sigmas_are_believed():
    rng = np.random.default_rng(2)
    view, camera, _ = drawn("marked_dots", rng, 0.5)
    seen = noisy(view, rng)
    one = board_pose(seen, camera).covariance
    third = board_pose(replace(seen, sigma=seen.sigma / 3), camera).covariance
    assert np.sqrt(np.diag(third) / np.diag(one)) == pytest.approx(1.0, abs=0.15)
    # Residuals that say less are not: what all points share shows in none of them.
    exact = board_pose(view, camera)
    assert exact.rms_px < 1e-3
    assert np.sqrt(np.diag(exact.covariance) / np.diag(one)) == pytest.approx(1.0, abs=0.15)


def test_a_few_points_far_off_do_not_move_the_pose():
    rng = np.random.default_rng(3)
    view, camera, truth = drawn("dots", rng, 0.4)
    seen = noisy(view, rng)
    moved = seen.pixels.copy()
    moved[[3, 17, 20]] += [[0.9, -0.4], [0.8, 0.5], [1.2, 0.0]]
    found = board_pose(replace(seen, pixels=moved), camera)
    error = difference(found.camera_from_board, truth)
    assert error @ np.linalg.solve(found.covariance, error) < 22.5  # χ² of 6 degrees of freedom, one in a thousand


@pytest.mark.parametrize("white", [BRIGHT, 340.0])
@pytest.mark.parametrize("slope", SLOPES)
def test_light_that_falls_off_moves_no_dot_not_even_where_white_saturates(slope, white):
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(30):
        x, y, radius = 64 + rng.uniform(-0.5, 0.5), 64 + rng.uniform(-0.5, 0.5), rng.uniform(14, 20)

        def dot(u, v, x=x, y=y, radius=radius):
            return 0.1 * white + 0.9 * white * ndtr((np.hypot(u - x, v - y) - radius) / PSF)

        start = Blobs(np.array([[64.0, 64.0]]), radius * np.eye(2)[None])
        uneven, even = (measure_dots(uneven_picture(dot, g), start)[0].centres[0] for g in (slope, (0.0, 0.0)))
        assert np.linalg.norm(even - (x, y)) < 0.04
        errors.append(uneven - even)
    # The dots, a tenth as bright, tell the light less well; taken as it is, white that saturates moves them by .03 px.
    most = MOST_MOVED_PX if white == BRIGHT else 2.5 * MOST_MOVED_PX
    assert np.abs(np.mean(errors, axis=0)).max() < most


def test_dots_that_a_laser_line_moved_alike_are_dropped_also_at_the_boards_corner():
    rng = np.random.default_rng(6)
    view, _, _ = drawn("dots", rng, 0.3)
    view = noisy(replace(view, sigma=np.full(len(view.ids), 0.012)), rng)
    cols = view.spec.cols
    lit = [0, cols + 1, 2 * cols + 2, 3 * cols + 3, 4 * cols + 4]
    pixels, sigma = view.pixels.copy(), view.sigma.copy()
    pixels[lit] += [[7.0, -3.0], [7.2, -3.1], [6.8, -3.2], [6.7, -2.9], [-7.0, 3.0]]
    sigma[lit] = 0.35
    kept = without_outliers(replace(view, pixels=pixels, sigma=sigma))
    assert not set(lit) & set(kept.ids.tolist())
    assert len(kept.ids) >= len(view.ids) - len(lit) - 1
