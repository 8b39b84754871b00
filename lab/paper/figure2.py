"""The design study behind the paper's Figure 2: error and light over the sensor for a baseline and a focal length.

docs/explanation/theory.md, section 3. Two families of heads are told apart, because the paper mixes them: those whose
light plane meets the optical axis at the same distance Z0, and those with the same θ. What 30 and 35 mm of baseline
give, and which rule chooses 35 mm.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

Array = NDArray[np.float64]

HALF_SENSOR = 1e-3
"""The paper's part near the principal point: |x'|, |y'| ≤ 1 mm."""
STAND_OFF = 0.150
"""The paper's stand-off, m."""
PIXEL = 4.8e-6


@dataclass(frozen=True)
class Head:
    """A scan head as the paper draws it: baseline l and focal length f in m, θ in rad at the laser."""

    baseline: float
    focal: float
    theta: float

    @classmethod
    def at_stand_off(cls, baseline: float, focal: float) -> Self:
        """The head whose light plane meets the optical axis at `STAND_OFF` (equation 6)."""
        return cls(baseline, focal, float(np.arctan2(STAND_OFF, baseline)))

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

    def usable_depth(self) -> tuple[float, float]:
        """Nearest and farthest Z in m within |x'| ≤ `HALF_SENSOR`."""
        near, far = self.depth([-HALF_SENSOR, HALF_SENSOR])
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
    found = {"dx": dx, "dy": np.abs(by_1) + np.abs(by_2), "dz": dz, "rms": np.sqrt(dx**2 + by_1**2 + by_2**2 + dz**2)}
    return {name: np.where(np.isfinite(value), value, np.inf) for name, value in found.items()}


def largest_dz(head: Head, delta: float) -> float:
    """The largest |dZ| in m for |x'| ≤ `HALF_SENSOR`: it is at x' = +1 mm, nearest to the vanishing line."""
    return float(errors(head, HALF_SENSOR, 0.0, delta)["dz"])


def delta_limit(head: Head, demand: float) -> float:
    """The largest stripe error δ in m at which |dZ| ≤ `demand` m for |x'| ≤ `HALF_SENSOR`; 0 when there is none."""
    per_metre = largest_dz(head, 1.0)
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
    geometric = light.sheet * head.focal / (head.depth(x) * light.pixel * np.sin(head.theta))
    sigma = np.sqrt(geometric**2 + light.psf_px**2 + 1 / 12)
    return np.asarray(row_power(head, x, light) * erf(1 / (2 * np.sqrt(2) * sigma)), dtype=np.float64)


def uniformity(head: Head, light: Light) -> float:
    """Smallest over largest peak power for |x'| ≤ `HALF_SENSOR`; 0 when part of it is beyond the vanishing line."""
    powers = peak_power(head, np.linspace(-HALF_SENSOR, HALF_SENSOR, 201), light)
    return float(powers.min() / powers.max())


FOCAL = 8e-3
DELTA = 0.1 * PIXEL
"""The stripe error that the maps are drawn for: a tenth of a pixel, m."""
BASELINES = (0.030, 0.035)
CLAIMS = ((0.030, 0.5e-3), (0.035, 0.2e-3))
"""Baseline and largest error that the paper states for it, m."""
FOCALS = (6.54e-3, 8e-3, 12e-3, 16e-3)
GRID = tuple(round(0.005 * k, 3) for k in range(4, 17))
"""Baselines on a 5 mm grid, m."""
DEMAND = 0.2e-3
LEVELS_MM = (0.02, 0.05, 0.1, 0.2)


def smallest_baseline(delta: float) -> float | None:
    """The smallest baseline in m on the 5 mm grid that keeps |dZ| ≤ `DEMAND` at a stripe error of `delta` m."""
    for baseline in GRID:
        if delta_limit(Head.at_stand_off(baseline, FOCAL), DEMAND) >= delta:
            return baseline
    return None


def figure2() -> dict[str, Any]:
    """Every number of the study as plain data; lengths in mm or µm as their names say, angles in degrees."""
    light = Light()
    one_apart = Head.at_stand_off(GRID[GRID.index(0.035) - 1], FOCAL)
    return {
        "note": "computed from the corrected equations; the paper states neither its stripe error nor its focal length",
        "assumed": {
            "focal_mm": 1e3 * FOCAL,
            "half_sensor_mm": 1e3 * HALF_SENSOR,
            "stand_off_mm": 1e3 * STAND_OFF,
            "stripe_error_um": 1e6 * DELTA,
            "pixel_um": 1e6 * PIXEL,
            "laser_mw": 1e3 * light.power,
            "fan_deg": round(float(np.degrees(light.fan)), 6),
            "f_number": light.f_number,
            "albedo": light.albedo,
            "transmission": light.transmission,
            "sheet_sigma_um": 1e6 * light.sheet,
            "psf_sigma_px": light.psf_px,
        },
        "maps": [_map(baseline) for baseline in BASELINES],
        "limits": [
            {
                "focal_mm": 1e3 * focal,
                **{
                    f"delta_um_for_{1e3 * claim:g}_mm_at_l_{1e3 * baseline:g}": 1e6
                    * delta_limit(Head.at_stand_off(baseline, focal), claim)
                    for baseline, claim in CLAIMS
                },
            }
            for focal in FOCALS
        ],
        "choice": {
            "rule": "smallest baseline on a 5 mm grid whose largest |dZ| over ±1 mm is 0.2 mm or less",
            "chosen_mm": 1e3 * (smallest_baseline(DELTA) or float("nan")),
            "chosen_for_delta_um": [
                1e6 * delta_limit(one_apart, DEMAND),
                1e6 * delta_limit(Head.at_stand_off(0.035, FOCAL), DEMAND),
            ],
            "baselines": [_row(baseline, light) for baseline in GRID],
        },
        "energy": {
            "change_from_30_to_35": float(
                peak_power(Head.at_stand_off(0.035, FOCAL), 0.0, light)
                / peak_power(Head.at_stand_off(0.030, FOCAL), 0.0, light)
                - 1
            )
        },
    }


def _map(baseline: float) -> dict[str, Any]:
    head = Head.at_stand_off(baseline, FOCAL)
    axis = np.linspace(-HALF_SENSOR, HALF_SENSOR, 201)
    found = errors(head, axis[None, :], axis[:, None], DELTA)
    return {
        "baseline_mm": 1e3 * baseline,
        "theta_deg": float(np.degrees(head.theta)),
        "largest_mm": {name: 1e3 * float(value.max()) for name, value in found.items()},
        "centre_mm": {name: 1e3 * float(value[100, 100]) for name, value in found.items()},
        "depth_mm": [1e3 * z for z in head.usable_depth()],
    }


def _row(baseline: float, light: Light) -> dict[str, float]:
    head = Head.at_stand_off(baseline, FOCAL)
    near, far = head.usable_depth()
    return {
        "baseline_mm": 1e3 * baseline,
        "largest_dz_mm": 1e3 * largest_dz(head, DELTA),
        "delta_limit_um": 1e6 * delta_limit(head, DEMAND),
        "uniformity": uniformity(head, light),
        "near_mm": 1e3 * near,
        "far_mm": 1e3 * far,
    }


def draw(path: Path) -> None:
    """|dX|, |dY|, |dZ| over the sensor, a row for each baseline, all on one colour scale, as an image file."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.5, 8.2), dpi=110, layout="constrained")
    figure.suptitle(
        f"Error over the sensor: f = {1e3 * FOCAL:g} mm, light plane meets the axis at 150 mm, "
        f"stripe error {1e6 * DELTA:.2f} µm (0.1 px of 4.8 µm)"
    )
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    side = np.linspace(-HALF_SENSOR, HALF_SENSOR, 201)
    found = [errors(Head.at_stand_off(b, FOCAL), side[None, :], side[:, None], DELTA) for b in BASELINES]
    top = 1e3 * max(float(maps[name].max()) for maps in found for name in ("dx", "dy", "dz"))
    shown = None
    for row, (baseline, maps) in enumerate(zip(BASELINES, found, strict=True)):
        for column, name in enumerate(("dx", "dy", "dz")):
            place = axes[row, column]
            values = 1e3 * maps[name]
            shown = place.imshow(
                values, extent=(-1, 1, -1, 1), origin="lower", cmap="viridis", norm=LogNorm(2e-3, top), aspect="equal"
            )
            lines = place.contour(1e3 * side, 1e3 * side, values, levels=LEVELS_MM, colors="white", linewidths=0.9)
            place.clabel(lines, fmt="%g mm", fontsize=8)
            place.set_title(f"|d{name[1].upper()}|, l = {1e3 * baseline:g} mm: largest {values.max():.3f} mm")
            place.set_xticks([-1, -0.5, 0, 0.5, 1])
            place.set_yticks([-1, -0.5, 0, 0.5, 1])
            if row == 1:
                place.set_xlabel("x' across the stripe in mm")
            if column == 0:
                place.set_ylabel("y' along the stripe in mm")
    assert shown is not None
    ticks = [t for t in (0.002, 0.005, 0.01, *LEVELS_MM, 0.5) if t <= top]
    bar = figure.colorbar(shown, ax=axes, label="largest error in mm for stripe errors of ±δ (log)", shrink=0.85)
    bar.set_ticks(ticks, labels=[f"{t:g}" for t in ticks])
    figure.savefig(path)
