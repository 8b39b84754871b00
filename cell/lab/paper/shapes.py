"""Surfaces for the comparison with other systems: the cell's free-form relief at any size, and a plate with a dent."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics import Mesh
from sim_backends.world.surfaces import HALF_X, HALF_Y
from sim_backends.world.surfaces import mesh as surface_mesh

Array = NDArray[np.float64]

DENT_DEPTH, DENT_RADIUS, DENT_FLANK = 0.002, 0.005, 0.0008
PLATE = 0.030


@cache
def relief(length: float, width: float, triangles: int = 40_000) -> Mesh:
    """The pot's relief stretched to `length` (x) by `width` (y) in m, as steep as the original on average.

    Its middle height is z = 0, z towards the scanner.
    """
    made = surface_mesh("pot", triangles, False)
    scale = np.array([length / (2 * HALF_X), width / (2 * HALF_Y), 0.0])
    scale[2] = float(np.sqrt(scale[0] * scale[1]))
    vertices = made.vertices * scale
    vertices[:, 2] -= 0.5 * (vertices[:, 2].min() + vertices[:, 2].max())
    return Mesh(vertices, made.triangles)


@cache
def dented_plate(points: int = 241) -> Mesh:
    """A square plate with a round dent in its middle; z = 0 on the plate, −`DENT_DEPTH` on the dent's floor."""
    side = np.linspace(-0.5 * PLATE, 0.5 * PLATE, points)
    x, y = np.meshgrid(side, side, indexing="ij")
    z = -0.5 * DENT_DEPTH * (1 - np.tanh((np.hypot(x, y) - DENT_RADIUS) / DENT_FLANK))
    index = np.arange(points * points).reshape(points, points)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    vertices = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    return Mesh(vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]))
