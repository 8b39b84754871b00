"""The search that takes most lines side by side, against the one that takes any line by itself."""

import numpy as np
import pytest

from cell.measure.vision.stripe.extract import extract
from cell.measure.vision.stripe.ordinary.find import CANDIDATES, CUT, ENERGY, NOWHERE, START, find_line, find_lines
from lab.bench.stripe.truth import Cell, draw

SHAPE = (200, 333)
LEAST_PEAK, SATURATION = 8.0, 255


def stripe(*cell: float) -> np.ndarray:
    return draw(Cell(*cell), SHAPE, 1)[0]


def noise(mean: float, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    return np.clip(np.random.default_rng(3).poisson(mean, shape), 0, 255).astype(np.uint8)


def with_rivals() -> np.ndarray:
    """A stripe with a second one beside it, far in some lines and equally bright in others, and gaps."""
    image = stripe(2.0, 120.0, 0.2)
    image[:, 300:305] = 200
    image[50:100] = np.maximum(image[50:100], np.roll(image[50:100], 25, axis=1))
    image[::7] = 5
    return image


PICTURES = {
    "a stripe": stripe(2.0, 150.0), "a faint stripe": stripe(1.2, 20.0), "coarse speckle": stripe(3.0, 220.0, 0.5),
    "a saturated stripe": stripe(2.0, 900.0), "rivals": with_rivals(),
    "a stripe at the border": np.roll(stripe(2.0, 150.0), SHAPE[1] // 2, axis=1),
    "jumps": np.stack([np.roll(line, 97 * k) for k, line in enumerate(stripe(2.0, 150.0))]),
    "nothing but noise": noise(20.0), "anything": np.random.default_rng(4).integers(0, 256, SHAPE).astype(np.uint8),
    "white": np.full(SHAPE, 255, np.uint8), "a small picture": noise(30.0, (40, 33)),
}  # fmt: skip


@pytest.mark.parametrize("with_dark", [False, True])
@pytest.mark.parametrize("name", PICTURES)
def test_any_line_is_searched_side_by_side_as_by_itself(name, with_dark):
    image = PICTURES[name]
    dark = np.minimum(noise(6.0, image.shape), image) if with_dark else np.zeros((1, 1), np.uint8)
    seen = image - dark if with_dark else image
    together, alone = np.zeros((2, len(image), CANDIDATES, START))
    cut, cut_at = np.zeros((len(image), CUT), np.uint8), np.full(len(image), NOWHERE)
    several = find_lines(image, seen, dark, SATURATION, LEAST_PEAK, together, cut, cut_at)
    for r in np.flatnonzero(cut_at != NOWHERE):
        np.testing.assert_array_equal(cut[r], image[r, cut_at[r] : cut_at[r] + CUT])
    line, rises = np.empty(image.shape[1], np.float32), np.empty(image.shape[1], np.uint8)
    two = [find_line(image, seen, dark, r, SATURATION, LEAST_PEAK, line, rises, alone) for r in range(len(image))]
    np.testing.assert_allclose(together, alone, atol=1e-3)
    assert several == any(two) == bool(together[:, 1, ENERGY].any())


def test_light_wider_than_any_stripe_in_a_picture_so_wide_that_it_is_shrunk_is_no_stripe():
    x = np.arange(5472)
    light = 60 + 120 * np.exp(-0.5 * ((x - 2200) / 90) ** 2)
    image = np.clip(light + np.random.default_rng(0).normal(0, 2, (240, len(x))), 0, 255).astype(np.uint8)
    assert not len(extract(image).rows)
