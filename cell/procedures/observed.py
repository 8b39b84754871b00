"""What the steps let a listener at the gate see besides the devices' own states."""

from __future__ import annotations

from dataclasses import dataclass

from cell.measure.reconstruction.cloud import Cloud
from drivers.interfaces import Vector


@dataclass(frozen=True, eq=False)
class RailPath:
    """What the rail told during a sweep: `samples` (n, 2), host time in s and position in m."""

    samples: Vector


@dataclass(frozen=True, eq=False)
class TimedCloud:
    """A cloud, and the host `times` (lines,) in s at which its lines were taken."""

    cloud: Cloud
    times: Vector
