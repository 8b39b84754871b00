"""How late the scan camera's stamps come against the rail's positions, and its shutter, as kept with a calibration.

Found by `cell.measure.calibration.drift.timing_fit`, from sweeps of `cell.procedures.calibrate.timing`. Both hold for
the settings of camera and rail with which they were found: another driver, packet size or baud rate makes stamps or
readings come otherwise.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Shutter:
    """The scan camera's last row is exposed `readout` ± `sigma` s after its first one, set up as `link` says."""

    readout: float
    sigma: float
    link: dict[str, str]

    def as_dict(self) -> dict[str, object]:
        """For storage."""
        return dict(vars(self))

    @classmethod
    def read(cls, data: dict[str, Any] | None) -> Shutter | None:
        """From storage; KeyError, TypeError, AttributeError or ValueError when it is none."""
        if data is None:
            return None
        made = cls(float(data["readout"]), float(data["sigma"]), _link(data))
        if not (np.isfinite(made.readout) and 0 < made.sigma < np.inf):
            raise ValueError(f"a readout of {made.readout} ± {made.sigma} s")
        return made

    def summary(self) -> dict[str, float]:
        """For reports and people, units in the names."""
        return {"readout_ms": round(1e3 * self.readout, 4), "sigma_ms": round(1e3 * self.sigma, 4)}


@dataclass(frozen=True)
class StampTiming:
    """The camera's stamps come `late` ± `sigma` s after the exposures that the rail's positions are told for.

    `play` ± `play_sigma` m is by how much the carriage stands otherwise when it came from the other side; `readout` ±
    `readout_sigma` s from the first row's exposure to the last one's; `by_exposure` s of lateness per s of exposure.
    `made` is in seconds since the epoch, `link` how camera and rail were set up.
    """

    late: float
    sigma: float
    play: float
    play_sigma: float
    readout: float
    readout_sigma: float
    by_exposure: float
    made: float
    link: dict[str, str]

    def as_dict(self) -> dict[str, object]:
        """For storage."""
        return dict(vars(self))

    @classmethod
    def read(cls, data: dict[str, Any] | None) -> StampTiming | None:
        """From storage; KeyError, TypeError, AttributeError or ValueError when it is none."""
        if data is None:
            return None
        figures = {name: float(data[name]) for name in cls.__dataclass_fields__ if name != "link"}
        made = cls(**figures, link=_link(data))
        if not (np.isfinite(list(figures.values())).all() and made.sigma > 0):
            raise ValueError(f"time stamps that are {made.late} ± {made.sigma} s late")
        return made

    @property
    def date(self) -> str:
        """When it was made, for people."""
        return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.made))

    def summary(self) -> dict[str, object]:
        """For reports and people, units in the names."""
        return {
            "late_ms": round(1e3 * self.late, 4),
            "sigma_ms": round(1e3 * self.sigma, 4),
            "play_um": round(1e6 * self.play, 2),
            "play_sigma_um": round(1e6 * self.play_sigma, 2),
            "readout_ms": round(1e3 * self.readout, 4),
            "readout_sigma_ms": round(1e3 * self.readout_sigma, 4),
            "late_per_exposure": round(self.by_exposure, 4),
            "date": self.date,
        }


def _link(data: dict[str, Any]) -> dict[str, str]:
    return {str(name): str(value) for name, value in data["link"].items()}
