"""How a line runs is found, in which colour it stands out, and whether it is surely the laser's."""

from __future__ import annotations

import numpy as np
import pytest

from cell.measure.vision import LaserChannel, PictureRefused, extract, read_stripe
from lab.bench.stripe.workshop import Scene, draw


def test_a_core_that_is_saturated_in_one_channel_is_read_in_another():
    rng = np.random.default_rng(0)
    column = np.arange(480)
    centres = 240 + 0.2 * np.arange(384)
    stripe = np.exp(-0.5 * ((column - centres[:, None]) / 2.0) ** 2)
    planes = [rng.poisson((8 + peak * stripe) * 40) / 40 for peak in (3000.0, 150.0, 20.0)]
    image = np.clip(np.round(np.stack(planes, axis=2)), 0, 255).astype(np.uint8)
    profile = extract(image)
    assert not profile.saturated.any()
    assert np.sqrt(np.nanmean((profile.centres - centres) ** 2)) < 0.02
    assert extract(image, laser=LaserChannel.RED).saturated.all()


def test_which_way_a_line_runs_is_found_and_a_picture_without_one_has_none():
    image, centres = draw(Scene("Gaussian", 2.0, camera="green"), 2)
    seen = read_stripe(np.ascontiguousarray(image.transpose(1, 0, 2)))
    assert seen is not None
    assert seen.axis == "columns"
    assert np.nanmax(np.abs(seen.centres - centres)) < 1.0
    noise = np.random.default_rng(0).normal(80, 6, (200, 300)).clip(0, 255).astype(np.uint8)
    assert read_stripe(noise) is None


def test_a_faint_line_beside_another_is_refused_until_the_laser_stands_out():
    """A grey picture in which a fold of paper is as clear as the laser; in colour, or without the fold, it is sure."""
    row, column = np.mgrid[:240, :320]
    noise = np.random.default_rng(3).normal(0, 3, (240, 320, 3))
    laser = 10 * np.exp(-0.5 * ((column - 100 - 0.1 * row) / 2) ** 2)
    fold = 10 * np.exp(-0.5 * ((column - 220 + 0.1 * row) / 2) ** 2)
    colour = 60 + noise + fold[:, :, None] + laser[:, :, None] * (3.0, 0.0, 0.0)
    colour = np.clip(np.rint(colour), 0, 255).astype(np.uint8)
    grey = np.clip(np.rint(60 + noise[:, :, 0] + fold + laser), 0, 255).astype(np.uint8)
    with pytest.raises(PictureRefused, match=r"which line is the laser's is not sure.*laser off"):
        read_stripe(grey)
    off = np.clip(np.rint(60 + noise[:, :, 1] + fold), 0, 255).astype(np.uint8)
    for seen in (read_stripe(colour), read_stripe(grey, off)):
        assert seen is not None
        assert np.nanmedian(np.abs(seen.centres - 100 - 0.1 * np.arange(240))) < 0.5
