"""The design study behind the paper's Figure 2: error and light over the sensor for a baseline and a focal length.

docs/explanation/theory.md, section 3. Two families of heads are told apart, because the paper mixes them: those whose
light plane meets the optical axis at the same distance Z0 (θ follows from the baseline), and those with the same θ (Z0
follows).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

Array = NDArray[np.float64]

HALF_SENSOR = 1e-3
"""The paper's part near the principal point: |x'|, |y'| ≤ 1 mm."""
STAND_OFF = 0.150
"""The paper's stand-off, m."""
TAN_THETA = 3.5
"""The paper's tangent of the angle between baseline and light plane."""
PIXEL = 4.8e-6


@dataclass(frozen=True)
class Head:
    """A scan head as the paper draws it: baseline l and focal length f in m, θ in rad at the laser."""

    baseline: float
    focal: float
    theta: float

    @classmethod
    def at_stand_off(cls, baseline: float, focal: float, stand_off: float = STAND_OFF) -> Head:
        """The head whose light plane meets the optical axis at `stand_off` m (equation 6)."""
        return cls(baseline, focal, float(np.arctan2(stand_off, baseline)))

    @property
    def stand_off(self) -> float:
        """Where the light plane meets the optical axis: Z = l tanθ, m (equation 6)."""
        return self.baseline * float(np.tan(self.theta))

    @property
    def vanishing(self) -> float:
        """x' in m of the light plane's vanishing line, f cotθ: Z is infinite there (the paper's "error peak")."""
        return self.focal / float(np.tan(self.theta))

    def depth(self, x: ArrayLike) -> Array:
        """Z in m at sensor coordinate x' in m; infinite at and beyond the vanishing line."""
        d = self.vanishing - np.asarray(x, dtype=np.float64)
        return np.where(d > 0, self.baseline * self.focal / np.where(d > 0, d, 1.0), np.inf)

    def usable_depth(self, half: float = HALF_SENSOR) -> tuple[float, float]:
        """Nearest and farthest Z in m within |x'| ≤ `half`."""
        near, far = self.depth([-half, half])
        return float(near), float(far)


def errors(head: Head, x: ArrayLike, y: ArrayLike, delta: float) -> dict[str, Array]:
    """Errors in m at sensor coordinates x', y' in m for stripe errors of `delta` m in both directions.

    dx, dy, dz: the largest that δ1, δ2 = ±delta can make (equation 5 with the right dy, signs at their worst);
    `rms`: the length of the error when δ1 and δ2 are independent with standard deviation `delta`. Infinite beyond the
    vanishing line.
    """
    xs, ys = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    d = head.vanishing - xs
    square = np.where(d > 0, d, np.nan) ** 2
    l, f, fc = head.baseline, head.focal, head.vanishing  # noqa: E741 the paper's letter
    dx, dz = l * fc * delta / square, l * f * delta / square
    by_1, by_2 = l * ys * delta / square, l * (fc - xs) * delta / square
    found = {
        "dx": dx,
        "dy": np.abs(by_1) + np.abs(by_2),
        "dz": dz,
        "rms": np.sqrt(dx**2 + by_1**2 + by_2**2 + dz**2),
    }
    return {name: np.where(np.isfinite(value), value, np.inf) for name, value in found.items()}


def largest_dz(head: Head, delta: float, half: float = HALF_SENSOR) -> float:
    """The largest |dZ| in m for |x'| ≤ `half` m: it is at x' = +half, nearest to the vanishing line."""
    return float(errors(head, half, 0.0, delta)["dz"])


def delta_limit(head: Head, demand: float, half: float = HALF_SENSOR) -> float:
    """The largest stripe error δ in m at which |dZ| ≤ `demand` m for |x'| ≤ `half` m; 0 when none is small enough."""
    per_metre = largest_dz(head, 1.0, half)
    return demand / per_metre if np.isfinite(per_metre) else 0.0


@dataclass(frozen=True)
class Light:
    """What decides how bright the stripe is: laser power in W, fan angle in rad, sheet's σ in m, and the camera.

    `f_number`, surface `albedo`, `transmission` of lens and filter, `psf_px` the lens's point spread (σ in px), `pixel`
    in m.
    """

    power: float = 0.020
    fan: float = float(np.deg2rad(60.0))
    sheet: float = 80e-6
    f_number: float = 4.0
    albedo: float = 0.5
    transmission: float = 0.9
    psf_px: float = 0.6
    pixel: float = PIXEL


def row_power(head: Head, x: ArrayLike, light: Light) -> Array:
    """Power in W that one image row receives from the stripe at x' in m: P_row of docs/explanation/theory.md, section
    3."""
    xs = np.asarray(x, dtype=np.float64)
    z = head.depth(xs)
    cos = head.focal / np.hypot(head.focal, xs)
    # The laser's reach Z/sinθ and the length p Z/f that a row sees share their Z, which may be infinite.
    lit = light.power * np.sin(head.theta) / (2 * np.tan(light.fan / 2)) * (light.pixel / head.focal)
    lens = np.pi * (head.focal / light.f_number) ** 2 / 4 * cos * (cos / z) ** 2
    return np.asarray(lit * light.albedo / np.pi * cos * lens * light.transmission, dtype=np.float64)


def peak_power(head: Head, x: ArrayLike, light: Light) -> Array:
    """Power in W in the brightest pixel of a row at x' in m: P_row · erf(1/(2√2 σ_px))."""
    z = head.depth(x)
    geometric = light.sheet * head.focal / (z * light.pixel * np.sin(head.theta))
    sigma = np.sqrt(geometric**2 + light.psf_px**2 + 1 / 12)
    return np.asarray(row_power(head, x, light) * erf(1 / (2 * np.sqrt(2) * sigma)), dtype=np.float64)


def uniformity(head: Head, light: Light, half: float = HALF_SENSOR) -> float:
    """Smallest over largest peak power for |x'| ≤ `half` m; 0 when part of it is beyond the vanishing line."""
    powers = peak_power(head, np.linspace(-half, half, 201), light)
    return float(powers.min() / powers.max())
