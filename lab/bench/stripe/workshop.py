"""Pictures of stripes as workshops have them, with known centres and their own Cramér–Rao bound.

Profiles that are no Gaussian, widths from .6 to 30 px, texture, colour and depth. Nothing here is the estimator's:
profiles are functions of the place, integrated over the pixel by sums; the bound is that of the profile itself, with
centre, height and a linear background unknown.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from lab.bench.stripe.truth import ELECTRONS_PER_DN, READ_NOISE_DN

Array = NDArray[np.float64]

AMBIENT, SLOPE = 8.0, 0.02
ACROSS = 9
"""Sub-pixels over which a profile is integrated."""


@dataclass(frozen=True)
class Scene:
    """One condition: the `profile`'s name, its width in px, peak in DN, texture's standard deviation in DN and its size
    in px, and how the camera gives it: "grey", "12 bit low" or "high", in colour with a "red" or "green" laser."""

    profile: str
    width: float
    peak: float = 120.0
    texture: float = 0.0
    grain: float = 2.0
    camera: str = "grey"

    @property
    def name(self) -> str:
        """For tables."""
        texture = f", texture {self.texture:.0f} DN" if self.texture else ""
        return f"{self.profile}{texture}, {self.camera}"

    @property
    def shape(self) -> tuple[int, int]:
        """Of the picture: room for the stripe and what surrounds it."""
        return (400, 640) if self.width < 8 else (400, 1280)


def profile(name: str, x: Array, width: float) -> Array:
    """A profile of height 1 at most at `x` px from its centre."""
    if name == "Gaussian":
        return np.asarray(np.exp(-0.5 * (x / width) ** 2))
    if name == "flat top":
        edge = np.sqrt(2) * (0.35 * width + 0.5)
        return np.asarray(0.5 * (erf((x + 2 * width) / edge) - erf((x - 2 * width) / edge)))
    if name == "halo":
        return np.asarray(0.85 * np.exp(-0.5 * (x / width) ** 2) + 0.15 * np.exp(-0.5 * (x / (4 * width)) ** 2))
    if name == "one-sided":
        return np.asarray(np.exp(-0.5 * (x / np.where(x < 0, 0.6 * width, 1.6 * width)) ** 2))
    raise ValueError(f"unknown profile {name!r}")


def on_pixels(scene: Scene, x: Array) -> Array:
    """The profile averaged over pixels at `x` px from its centre."""
    sub = (np.arange(ACROSS) - (ACROSS - 1) / 2) / ACROSS
    return np.asarray(np.mean([profile(scene.profile, x + part, scene.width) for part in sub], axis=0))


def draw(scene: Scene, seed: int) -> tuple[NDArray[Any], Array]:
    """A picture as the scene's camera gives it and the true centre (h,) of each row, a gentle curve."""
    rng = np.random.default_rng(seed)
    height, width = scene.shape
    row = np.arange(height)
    centres = 0.5 * width + 0.08 * width * np.sin(row / 150 + seed) + 0.0317 * row + rng.uniform(-1, 1)
    column = np.arange(width)
    stripe = scene.peak * on_pixels(scene, column - centres[:, None])
    scenery = np.broadcast_to(AMBIENT + SLOPE * column, scene.shape)
    if scene.texture:
        pattern = gaussian_filter(rng.normal(size=scene.shape), scene.grain)
        scenery = scenery + 25.0 + scene.texture * pattern / pattern.std()
    if scene.camera in ("red", "green"):
        return _coloured(scene, stripe, scenery, rng), centres
    light = np.maximum(scenery + stripe, 0.0)
    steps = 16 if scene.camera.startswith("12 bit") else 1
    noisy = rng.poisson(light * ELECTRONS_PER_DN) / ELECTRONS_PER_DN + rng.normal(0, READ_NOISE_DN, scene.shape)
    counted = np.clip(np.round(noisy * steps), 0, 256 * steps - 1)
    if steps == 1:
        return counted.astype(np.uint8), centres
    return (counted * (16 if scene.camera.endswith("high") else 1)).astype(np.uint16), centres


def _coloured(scene: Scene, stripe: Array, scenery: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Red first: printed paper in white light that is brighter than the laser, which is seen a little in the others."""
    height, width = scene.shape
    print_ = 40.0 + 90.0 * ((np.arange(width) // 23 + np.arange(height)[:, None] // 31) % 2)
    shares = (1.0, 0.15, 0.05) if scene.camera == "red" else (0.1, 1.0, 0.12)
    planes = []
    for share in shares:
        light = scenery + gaussian_filter(print_, 0.8) + share * stripe
        noise = rng.normal(0, READ_NOISE_DN, scene.shape)
        planes.append(rng.poisson(light * ELECTRONS_PER_DN) / ELECTRONS_PER_DN + noise)
    return np.clip(np.round(np.stack(planes, axis=2)), 0, 255).astype(np.uint8)


def bound(scene: Scene) -> float:
    """Least standard deviation in px of an unbiased centre in one row of a grey picture without texture."""
    half = int(min(12 * scene.width + 8, scene.shape[1] / 2 - 2))
    rounding = 1 / 12 if scene.camera == "grey" else 1 / 12 / 256
    variances = []
    for phase in (-0.5, -0.25, 0.0, 0.25):
        x = np.arange(-half, half + 1.0)
        step = 1e-3
        stripe = scene.peak * on_pixels(scene, x - phase)
        rise = scene.peak * (on_pixels(scene, x - phase - step) - on_pixels(scene, x - phase + step)) / (2 * step)
        jacobian = np.stack([rise, stripe, np.ones_like(x), x / half], axis=1)
        light = stripe + AMBIENT + SLOPE * (x + 0.5 * scene.shape[1])
        variance = light / ELECTRONS_PER_DN + READ_NOISE_DN**2 + rounding
        variances.append(np.linalg.inv(jacobian.T @ (jacobian / variance[:, None]))[0, 0])
    return float(np.sqrt(np.mean(variances)))
