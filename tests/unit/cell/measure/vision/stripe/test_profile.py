"""Points of a stripe that may be off are marked with the reason."""

import numpy as np
from scipy.ndimage import gaussian_filter

from cell.measure.vision.stripe.extract import extract
from cell.measure.vision.stripe.profile import Mark
from lab.bench.stripe.workshop import Scene, draw

SHAPE = (384, 480)
ROW_COLUMN = np.indices(SHAPE)


def board(laser: float, seed: int, extra: float | np.ndarray = 0.0, ambient: float = 70.0):
    """A stripe (peak `laser` DN) across printed squares of albedo .3 and 1, blurred by the lens; the true centres."""
    rng = np.random.default_rng(seed)
    row, column = ROW_COLUMN
    squares = (column * np.cos(0.5) + row * np.sin(0.5)) // 40 + (row * np.cos(0.5) - column * np.sin(0.5)) // 40
    centres = 240 + 0.13 * (np.arange(SHAPE[0]) - 192)
    stripe = laser * np.exp(-0.5 * ((column - centres[:, None]) / 1.7) ** 2)
    light = gaussian_filter(np.where(squares % 2 > 0, 1.0, 0.3) * (ambient + stripe) + extra, 1.0) + 5
    noisy = rng.poisson(light * 40) / 40 + rng.normal(0, 0.4, SHAPE)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), centres


def test_edges_of_the_albedo_are_marked_and_a_picture_without_the_laser_takes_them_away():
    image, centres = board(120, 1, ambient=0.0)
    profile = extract(image)
    error = profile.centres - centres
    edges = (profile.marks & Mark.ALBEDO_EDGE) > 0
    assert np.sqrt(np.nanmean(error[~edges] ** 2)) < 0.06 < 0.15 < np.sqrt(np.nanmean(error[edges] ** 2))
    lit, _ = board(120, 1)
    without, _ = board(0, 2)
    read = extract(lit, without)
    assert read.valid.mean() > 0.99
    assert np.sqrt(np.nanmean((read.centres - centres) ** 2)) < 0.13
    clear = read.marks == 0
    assert np.sqrt(np.mean((read.centres - centres)[clear] ** 2) / np.mean(read.sigma[clear] ** 2)) < 1.3


def test_a_second_line_is_marked_where_it_is_and_not_taken():
    row, column = ROW_COLUMN
    second = 70 * np.exp(-0.5 * ((column - 300) / 2.5) ** 2) * ((row > 120) & (row < 250))
    image, centres = board(120, 3, second, ambient=5.0)
    profile = extract(image)
    assert np.nanmax(np.abs(profile.centres - centres)) < 3.0
    marked = (profile.marks & Mark.SECOND_LINE) > 0
    assert marked[125:245].mean() > 0.95 and marked[:110].mean() < 0.05


def test_a_step_is_marked():
    image, _ = draw(Scene("Gaussian", 2.0), 4)
    image[200:] = np.roll(image[200:], 40, axis=1)
    stepped = np.flatnonzero(extract(image).marks & Mark.STEP)
    assert set(stepped) >= {199, 200} and set(stepped) <= set(range(196, 204))


def test_scenery_that_is_brighter_than_the_laser_goes_with_the_picture_without_it():
    post = np.zeros(SHAPE)
    post[:, 400:403] = 90
    lit, centres = board(120, 1, post)
    without, _ = board(0, 2, post)
    assert ((extract(lit).marks & (Mark.SECOND_LINE | Mark.REFLECTION)) > 0).mean() > 0.9
    assert np.nanmax(np.abs(extract(lit, without).centres - centres)) < 1.0
