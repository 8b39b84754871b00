"""Sa, Sq and Sz of sines are their closed forms, the filter is scipy's, and noise is never taken for a surface."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from cell.measure.inversion.nominal import SIGMA_FLOOR
from cell.measure.inversion.texture import ALPHA, EDGE_WEIGHT, Heights, form_removed, gaussian, measure_texture

LINES, ROWS = 121, 201
PITCH, STEP = 0.5e-3, 0.18e-3
INDEX, WAVE = 2e-3, 0.006


def scanned(heights: np.ndarray | float, unsure: float = 0.0, shaken: float = 0.0) -> Heights:
    """A flat surface of 60 mm by 36 mm, its points high by `heights` (lines, rows), m."""
    x, y = np.meshgrid(PITCH * np.arange(LINES), STEP * np.arange(ROWS), indexing="ij")
    lines = np.repeat(np.arange(LINES), ROWS)
    places = np.column_stack([x.ravel(), y.ravel()])
    high, some = np.broadcast_to(heights, x.shape).ravel() * 1.0, np.arange(0, len(lines), 7)
    bow = unsure * np.sqrt(2.0) * np.sin(2.0 * np.pi * places[some, :1] / WAVE)
    return Heights(places, high, np.zeros((len(lines), 2)), lines, (PITCH, STEP), some, bow, shaken)


def sine(amplitude: float) -> np.ndarray:
    return amplitude * np.cos(2.0 * np.pi * PITCH * np.arange(LINES)[:, None] / WAVE)


def told(given: Heights) -> list[float]:
    made = measure_texture(given)
    return [value for value in (made.sa, made.sq, made.sz) if value is not None]


def test_the_filter_is_that_of_scipy_also_at_edges_and_holes():
    rng = np.random.default_rng(1)
    heights, weights = rng.normal(size=(90, 70)), np.ones((90, 70))
    weights[40:43, 20:24] = weights[60:80, 40:60] = 0.0
    sigma = ALPHA * 8.0 / np.sqrt(2.0 * np.pi)
    over, under = (gaussian_filter(v, sigma, mode="constant", truncate=12.0) for v in (weights * heights, weights))
    made = gaussian(heights, weights, 8.0, EDGE_WEIGHT)
    known = np.isfinite(made)
    np.testing.assert_allclose(made[known], (over / under)[known], atol=1e-12)
    # A narrow hole is bridged, a wide one is not.
    assert known[:55].all() and not known[65:75, 45:55].any()


@pytest.mark.parametrize("wavelength", [0.5, 1.0, 2.0, 5.0])
def test_half_of_a_wave_of_the_cutoffs_length_comes_through(wavelength: float):
    cutoff, cells = 20.0, np.arange(401) - 200.0
    wave = np.cos(2.0 * np.pi * cells / (wavelength * cutoff))[:, None] * np.ones((401, 60))
    through = gaussian(wave, np.ones_like(wave), cutoff, EDGE_WEIGHT)[200, 30]
    assert through == pytest.approx(2.0 ** -(wavelength**-2.0), abs=1e-6)


def test_a_sine_has_the_parameters_of_its_closed_form():
    sa, sq, sz = told(scanned(sine(0.05e-3)))
    through = 0.05e-3 * 2.0 ** -((INDEX / WAVE) ** 2)
    assert (sa, sq) == (pytest.approx(2.0 * through / np.pi, rel=0.02), pytest.approx(through / np.sqrt(2.0), rel=0.01))
    assert sz == pytest.approx(2.0 * through, rel=0.05)  # the form bends them


def test_form_and_pose_are_no_waviness():
    x, y = PITCH * np.arange(LINES)[:, None], STEP * np.arange(ROWS)
    bowl = 1e-3 + 0.01 * x - 0.02 * y + 0.3 * x**2 - 0.2 * x * y + 0.5 * y**2
    assert measure_texture(scanned(bowl)).sq is None
    assert told(scanned(bowl + sine(0.1e-3)))[1] == pytest.approx(told(scanned(sine(0.1e-3)))[1], rel=1e-6)
    # A curved surface that lies elsewhere seems high by its slopes.
    places, ways = scanned(0.0).places, [[500.0, 100.0], [-200.0, 400.0]]
    slopes = 0.3 * np.sin(places @ ways)
    turned = slopes @ [0.2e-3, -0.1e-3] + 2e-3 * (places[:, 0] * slopes[:, 1] - places[:, 1] * slopes[:, 0])
    assert np.abs(form_removed(places, slopes, turned)).max() < 1e-12 < 0.1e-3 < np.ptp(turned)


def noisy(seed: int, lines: float = 0.0) -> np.ndarray:
    """Noise (lines, rows) of 0.06 mm of each point by itself, and of whole `lines`, m."""
    rng = np.random.default_rng(seed)
    return np.asarray(rng.normal(0.0, 60e-6, (LINES, ROWS)) + rng.normal(0.0, lines, (LINES, 1)))


def test_noise_is_never_taken_for_a_surface():
    for made in (measure_texture(scanned(noisy(seed, lines=20e-6))) for seed in range(6)):
        assert (made.sa, made.sq, made.sz) == (None, None, None) and made.limit is not None
        assert f"below {1e3 * made.limit:.4f} mm cannot be told from the sensor's noise" in made.reason


def test_the_noise_is_taken_out_of_the_figures():
    plain = told(scanned(sine(0.06e-3)))[1]
    made = [measure_texture(scanned(sine(0.06e-3) + noisy(seed))) for seed in range(8)]
    off = np.array([(each.sq or np.nan) / plain - 1.0 for each in made])
    raw = np.array([np.hypot(each.sq or np.nan, each.noise or np.nan) / plain - 1.0 for each in made])
    assert abs(off.mean()) < 0.01 < 0.05 < raw.mean() and np.abs(off).max() < 0.05


def test_what_calibration_and_vehicle_leave_open_raises_the_limit():
    plain, shaken = measure_texture(scanned(sine(0.03e-3))), measure_texture(scanned(sine(0.03e-3), shaken=0.03e-3))
    unsure = measure_texture(scanned(sine(0.03e-3), unsure=5e-6))
    assert unsure.limit is not None and plain.limit == pytest.approx(SIGMA_FLOOR, rel=0.3)
    assert np.sqrt(unsure.limit**2 - SIGMA_FLOOR**2) == pytest.approx(10e-6, rel=0.03)
    assert unsure.sq == plain.sq is not None
    assert shaken.sq is None and "cannot be told from a vehicle that rocks" in shaken.reason


def without(given: Heights, gone: np.ndarray) -> Heights:
    left = ~gone
    places, heights, slopes, lines = (v[left] for v in (given.places, given.heights, given.slopes, given.lines))
    return Heights(places, heights, slopes, lines, given.steps, np.arange(len(lines)), np.zeros((len(lines), 1)))


def test_holes_and_an_outline_that_is_no_rectangle_change_little():
    whole = scanned(sine(0.1e-3) + 0.2 * noisy(1))
    x, y = whole.places.T
    holes = (np.abs(x - 0.02) < 0.001) & (np.abs(y - 0.01) < 0.001) | (np.hypot(x - 0.04, y - 0.02) < 0.005)
    made, area = measure_texture(without(whole, holes | (x + y < 0.015))), PITCH * (LINES - 1) * STEP * (ROWS - 1)
    assert measure_texture(whole).area == pytest.approx(area, rel=0.03)
    assert made.area == pytest.approx(area - np.pi * 0.005**2 - 0.5 * 0.015**2, rel=0.03)
    assert made.sq == pytest.approx(told(whole)[1], rel=0.03)


def test_too_little_gives_no_figure_but_the_reason():
    whole = scanned(sine(0.1e-3))
    few = measure_texture(without(whole, np.arange(len(whole.lines)) >= 300))
    assert few.reason == "300 points lie over the surface, at least 500 are needed"
    narrow = measure_texture(without(whole, whole.places[:, 1] > 0.008))
    assert "wide, at least 10.0 mm are needed with lines 0.50 mm apart" in narrow.reason
    for made in (few, narrow, measure_texture(without(whole, np.ones(len(whole.lines), dtype=bool)))):
        assert (made.sa, made.sq, made.sz, made.limit, made.measured()) == (None, None, None, None, ())
