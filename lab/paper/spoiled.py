"""Outliers put into a sweep's stripe centres, and how many of them the reconstruction's filter finds.

Three kinds: near ones of a few tenths of a millimetre, as the paper's (0.85 mm at most), far ones, and streaks along
the stripe as reflections make them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.reconstruction import Cloud, ProfileBuilder, ScanGeometry
from lab.paper.rig import RigSpec, Sweep, profile_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEAR_MM, FAR_MM = (0.3, 0.85), (1.0, 6.0)
STREAK_ROWS = (4, 10)


@dataclass(frozen=True, eq=False)
class Spoiled:
    """A sweep's centres with outliers in them; masks (lines, rows) of where, one for each kind."""

    centres: Array
    kinds: dict[str, Mask]

    @property
    def any(self) -> Mask:
        """Where anything was put in."""
        return np.asarray(np.logical_or.reduce(list(self.kinds.values())), dtype=np.bool_)


def spoil(sweep: Sweep, spec: RigSpec, share: float, rng: np.random.Generator) -> Spoiled:
    """Replace `share` of the points by outliers: half near, a quarter far, a quarter in streaks along the stripe."""
    centres = sweep.centres.copy()
    lines, rows = np.nonzero(np.isfinite(centres))
    total = round(share * len(lines))
    # Δu of one millimetre of depth: the closed form's ∂Z/∂x' = Z²/(l f), in pixels.
    px_per_mm = 1e-3 * spec.baseline * spec.focal / (spec.meeting**2 * spec.pixel)
    kinds = {name: np.zeros(centres.shape, dtype=np.bool_) for name in ("near", "far", "streak")}
    single = rng.choice(len(lines), 3 * total // 4, replace=False)
    near = len(single) * 2 // 3
    for name, chosen, (low, high) in (("near", single[:near], NEAR_MM), ("far", single[near:], FAR_MM)):
        kinds[name][lines[chosen], rows[chosen]] = True
        off = rng.uniform(low, high, len(chosen)) * rng.choice([-1.0, 1.0], len(chosen))
        centres[lines[chosen], rows[chosen]] += px_per_mm * off
    left = total - len(single)
    while left > 0:
        k = int(rng.integers(len(lines)))
        length = min(left, int(rng.integers(STREAK_ROWS[0], STREAK_ROWS[1] + 1)))
        line, first = int(lines[k]), int(rows[k])
        where = slice(first, first + length)
        fresh = np.isfinite(centres[line, where]) & ~kinds["near"][line, where] & ~kinds["far"][line, where]
        fresh &= ~kinds["streak"][line, where]
        if fresh.all() and len(fresh) == length:
            off = rng.uniform(*FAR_MM) * rng.choice([-1.0, 1.0])
            centres[line, where] += px_per_mm * (off + rng.normal(0, 0.02, length))
            kinds["streak"][line, where] = True
            left -= length
    return Spoiled(centres, kinds)


def reconstruct(sweep: Sweep, centres: Array, geometry: ScanGeometry, spec: RigSpec) -> Cloud:
    """The product's own reconstruction of the centres, in the frame of `geometry`, with its outlier filter."""
    builder = ProfileBuilder(geometry, len(centres))
    for columns, reading in zip(centres, sweep.readings, strict=True):
        builder.add(profile_of(columns, spec.noise.stripe), float(reading), spec.noise.rail)
    return builder.finish(pin.SE3.Identity())


def found_outliers(cloud: Cloud, spoiled: Spoiled) -> dict[str, float | int]:
    """Recall of each kind and of all, precision, and the counts behind them."""
    rejected, put = cloud.rejected, spoiled.any
    hits = int((rejected & put).sum())
    figures: dict[str, float | int] = {
        "injected": int(put.sum()),
        "rejected": int(rejected.sum()),
        "recall": hits / max(1, int(put.sum())),
        "precision": hits / max(1, int(rejected.sum())),
    }
    for name, mask in spoiled.kinds.items():
        figures[f"recall_{name}"] = int((rejected & mask).sum()) / max(1, int(mask.sum()))
    return figures
