"""From light to the picture: shot noise, read noise, saturation and quantisation of an 8-bit sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.compiled import compiled_fast

Image = NDArray[np.float32]


def sensor(image_dn: Image, optics: CameraOptics, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Expose: `image_dn` (height, width) expected DN → uint8 picture.

    Variance in DN² = DN / (electrons per DN) + read noise², drawn as a Gaussian (docs/explanation/theory.md, section
    4); the same state of `rng` gives the same picture.
    """
    picture = np.empty(image_dn.shape, dtype=np.uint8)
    seed = rng.integers(0, 2**63, dtype=np.uint64)
    quantise(
        np.ascontiguousarray(image_dn, dtype=np.float32).ravel(),
        np.float32(1.0 / optics.electrons_per_dn),
        np.float32(optics.read_noise_dn**2),
        seed,
        picture.ravel(),
    )
    return picture


@compiled_fast
def scramble(counter: np.uint64) -> np.uint64:
    """Splitmix64's finaliser: 64 random bits of a counter."""
    z = counter * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@compiled_fast
def gaussian(bits: np.uint64) -> np.float32:
    """Standard normal number as the sum of the eight bytes of `bits` (within ±4.8, kurtosis −0.15)."""
    mask = np.uint64(0x00FF00FF00FF00FF)
    pairs = (bits & mask) + ((bits >> np.uint64(8)) & mask)
    total = (pairs * np.uint64(0x0001000100010001)) >> np.uint64(48)
    return (np.float32(np.int64(total)) - np.float32(1020.0)) * np.float32(0.0047841)


@compiled_fast
def quantise(
    light: Image, gain: np.float32, read_variance: np.float32, seed: np.uint64, picture: NDArray[np.uint8]
) -> None:
    """Compiled core of `sensor` on flat arrays."""
    for i in range(light.shape[0]):
        level = max(light[i], np.float32(0.0))
        noise = np.sqrt(level * gain + read_variance) * gaussian(scramble(seed + np.uint64(i)))
        picture[i] = np.uint8(min(max(level + noise + np.float32(0.5), np.float32(0.0)), np.float32(255.0)))
