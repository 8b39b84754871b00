"""Drawn stripes, to be read and let go: what is loaded or compiled on first use is so before anything waits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.extract import extract


def drawn(height: int, width: int) -> Iterator[NDArray[np.uint8]]:
    """Two pictures (height, width): an ordinary one, and one whose stripe has a flat top, which is read carefully."""
    rows, columns = np.mgrid[:height, :width]
    away = columns - 0.5 * width - 4 * np.sin(rows / 40)
    grain = np.random.default_rng(0).normal(0.0, 2.0, away.shape)
    for stripe in (np.exp(-0.5 * (away / 2) ** 2), 1 / (1 + np.exp(2 * (np.abs(away) - 6)))):
        yield np.clip(12.5 + 140 * stripe + grain, 0, 255).astype(np.uint8)


def read_drawn() -> None:
    """Load the loops that read stripes; where they were not compiled yet, that takes some 20 s."""
    for picture in drawn(240, 320):
        extract(picture)
