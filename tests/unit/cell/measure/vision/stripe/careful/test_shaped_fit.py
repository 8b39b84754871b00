"""Centres by a profile of any shape, and the shape that samples show, against closed forms."""

import numpy as np
import pytest

from cell.measure.vision.stripe.careful.shaped_fit import Noise, Plane, fit_shape, gaussian, learn


def flat_top(x):
    return 1 / (1 + np.exp(2 * (np.abs(x) - 4)))


def test_a_learned_profile_is_that_of_the_samples_with_its_centre_at_zero():
    rng = np.random.default_rng(0)
    x = rng.uniform(-12, 12, 8000)
    shape = learn(x, flat_top(x - 0.3) + rng.normal(0, 0.02, len(x)), np.ones(len(x)), 3.0, 11.0)
    grid = np.linspace(-7, 7, 57)
    assert np.abs(shape.at(grid)[0] - flat_top(grid)).max() < 0.03
    assert shape.learned and not gaussian(3.0).learned


def test_centres_are_unbiased_and_their_deviation_true():
    rng, lines = np.random.default_rng(1), 400
    centres = 40 + rng.uniform(-0.5, 0.5, lines)
    light = 100 * np.exp(-0.5 * ((np.arange(80) - centres[:, None]) / 2) ** 2) + 10
    value = (light + rng.normal(0, 2.0, light.shape)).astype(np.float32)
    plane = Plane(value, np.ones(value.shape, np.bool_))
    found = fit_shape(plane, np.arange(lines), np.full(lines, 40.0), gaussian(2.0), Noise(4.0, 0.0), 0.1)
    assert found.good.all()
    score = (found.centre - centres) / found.fisher
    assert abs(score.mean()) < 0.2 and np.sqrt(np.mean(score**2)) == pytest.approx(1.0, abs=0.12)
    assert np.exp(found.log_scale) == pytest.approx(1.0, abs=0.2) and found.chi2.mean() == pytest.approx(1.0, abs=0.05)
