"""Daylight on the sensor: from the illuminance at the place to grey values, through a band-pass filter or without one.

A surface of albedo 1 under a spectral irradiance E(λ) puts E / (4 N²) onto the sensor behind a lens of f-number N. A
pixel of area A turns that into A η(λ) λ / (h c) electrons a second and watt. E is that of ASTM G173-03 (global, 110
klx), scaled to the illuminance; η is that of a usual grey CMOS sensor (EMVA 1288 data sheets). At 660 nm 100 klx are
1.3 W/m² a nanometre: 26 W/m² within 20 nm. The simulated laser's line has 8 W/m² in its middle, which is about .25 mW
in all of its fan (`LaserOptics.brightness`, the same lens and pixel).
"""

import numpy as np

from sim_backends.optics.lighting import AMBIENT_RATE

BandPass = tuple[float, float, float]
"""A filter's centre and width, m, and its transmission between: interference filters have steep edges."""

LASER = 660e-9
"""The laser's wavelength, m."""
_NM = np.arange(400.0, 1001.0)
_EVERY_50 = np.arange(400.0, 1001.0, 50.0)
# W/m² a nanometre at 110 klx; electrons a photon.
_G173 = (1.11, 1.55, 1.55, 1.53, 1.45, 1.42, 1.28, 1.23, 1.07, 0.91, 0.74, 0.35, 0.72)
_EFFICIENCY = (0.45, 0.62, 0.65, 0.62, 0.57, 0.50, 0.40, 0.31, 0.23, 0.16, 0.10, 0.06, 0.03)
_KLX, _PIXEL, _F_NUMBER, _ELECTRONS_PER_DN = 110.0, 4.8e-6, 4.0, 40.0
_HC = 6.626e-34 * 2.998e8
# Electrons a second and nanometre of a pixel, at 1 klx and albedo 1.
_ELECTRONS = (
    np.interp(_NM, _EVERY_50, _G173) * np.interp(_NM, _EVERY_50, _EFFICIENCY) * 1e-9 * _NM
    * _PIXEL**2 / (4.0 * _F_NUMBER**2 * _HC * _KLX)
)  # fmt: skip

ROOMS_PER_KLX = float(_ELECTRONS.sum()) / _ELECTRONS_PER_DN / AMBIENT_RATE
"""How many times the light of level 1, an ordinary room's, 1 klx of daylight is to the sensor without a filter."""


def share_passed(band: BandPass) -> float:
    """Share of daylight's electrons that is left behind the filter."""
    centre, width, transmission = band
    inside = np.abs(1e-9 * _NM - centre) <= 0.5 * width
    return float(transmission * _ELECTRONS[inside].sum() / _ELECTRONS.sum())


def laser_passed(band: BandPass) -> float:
    """Share of the laser's light that is left behind the filter: none where its band misses the laser."""
    centre, width, transmission = band
    return transmission if abs(LASER - centre) <= 0.5 * width else 0.0
