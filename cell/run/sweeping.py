"""A sweep that a run is doing, or did last, as whoever shows it takes it from the run."""

from __future__ import annotations

from dataclasses import dataclass

import pinocchio as pin

from cell.inversion import NominalSurface
from cell.steps.swath import Collector


@dataclass(frozen=True, eq=False)
class Sweeping:
    """Who takes its frames, where the surface is by the board before anything was registered, and the surface."""

    collector: Collector
    base_from_surface: pin.SE3
    nominal: NominalSurface
