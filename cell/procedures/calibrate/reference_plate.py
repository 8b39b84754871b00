"""A look at the witness of the laser's pointing: the rail to its end, the laser on, a few pictures of the plate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cell.config.cell_config import CellConfig
from cell.devices.devices import Devices
from cell.measure.calibration.drift.reference_plate import LEAST_ROWS, PlateLine
from cell.measure.vision import extract
from drivers.errors import DeviceFault, LimitError, RefusedError
from drivers.interfaces import Frame

PICTURES = 12
RATES_HZ = 30.0, 15.0, 10.0
"""The first that the camera can."""


def look_at_witness(config: CellConfig, devices: Devices, keep: Callable[[str, Frame], None]) -> PlateLine | None:
    """The witness now, the carriage left there; None where the cell has none or it is not in the picture."""
    position = config.laser.witness
    if position is None:
        return None
    devices.rail.move_to(position).wait(30.0)
    camera = devices.scan_camera
    configure_fast(devices, config.calibration.stripe_exposure)
    profiles = []
    with devices.interlocks.purpose("calibration"), devices.laser.lit():
        for k in range(PICTURES):
            frame = camera.grab()
            keep(f"witness-{k + 1}", frame)
            profiles.append(extract(frame.image))
    columns = np.array([np.where(profile.double, np.nan, profile.centres) for profile in profiles])
    sigma = np.array([profile.sigma for profile in profiles])
    seen = np.isfinite(columns).all(axis=0)
    mean = np.where(seen, columns.mean(axis=0), np.nan)
    found = PlateLine(float(devices.rail.state().position), mean, np.sqrt((sigma**2).mean(axis=0) / PICTURES))
    return _on_the_plate(found)


def configure_fast(devices: Devices, exposure: float, rates: Sequence[float] = RATES_HZ) -> float:
    """Set the scan camera to `exposure`, s, and the first of `rates`, Hz, that it takes; that rate, or what it raises
    at the last of them."""
    for rate in rates[:-1]:
        try:
            devices.scan_camera.configure(exposure, rate)
        except LimitError:
            continue
        except DeviceFault as fault:
            # A camera that says what it can only by what it makes of a wish.
            if fault.code != "camera.setting":
                raise
        else:
            return rate
    devices.scan_camera.configure(exposure, rates[-1])
    return rates[-1]


def require_witness(config: CellConfig, devices: Devices, keep: Callable[[str, Frame], None]) -> PlateLine:
    """The witness now, for a calibration that has seen it; `RefusedError` when there is none to see."""
    if config.laser.witness is None:
        raise RefusedError(
            "the calibration saw the laser's witness, but the configuration has no laser.witness now: put it back, or "
            "run `cell calibrate` to work without one"
        )
    if (seen := look_at_witness(config, devices, keep)) is None:
        raise RefusedError(
            "the laser's witness, which the calibration saw, is not in the picture: see that the plate on the claw is "
            "in its place and clean, and that the laser is lit; if so, run `cell calibrate`"
        )
    return seen


def _on_the_plate(seen: PlateLine) -> PlateLine | None:
    """Only the longest run of rows without a step: what lies behind the plate moves with the arm."""
    rows = seen.rows
    if len(rows) < LEAST_ROWS:
        return None
    steps = (np.diff(rows) > 3) | (np.abs(np.diff(seen.columns[rows])) > 3.0)
    longest = max(np.split(rows, np.flatnonzero(steps) + 1), key=len)
    if len(longest) < LEAST_ROWS:
        return None
    columns = np.full_like(seen.columns, np.nan)
    # The plate's edges are left out: half of the line is beside them.
    kept = longest[5:-5]
    columns[kept] = seen.columns[kept]
    return replace(seen, columns=columns)
