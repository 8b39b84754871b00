"""Square roots of covariances whose parameters have different units, for variants, draws and propagation."""

from __future__ import annotations

import numpy as np

from cell.measure.geometry.camera import Array

NEGLIGIBLE = 1e-12
"""Of the correlations' eigenvalues; their sum is the number of parameters."""


def covariance_root(covariance: Array) -> Array:
    """Columns (n, m), m ≤ n, whose outer products sum to a covariance (n, n): one for each independent direction.

    Every parameter is taken in units of its own deviation: beside a focal length in px a hundredth of a millimetre in m
    would look like nothing, and be left out. Parameters without variance have zeros.
    """
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    kept = values > NEGLIGIBLE
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]), dtype=np.float64)
