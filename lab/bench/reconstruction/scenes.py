"""Synthetic organised clouds with known outliers and holes, and how soon a sweep's cloud is there: no optics."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import from_parts
from cell.measure.reconstruction.build import ProfileBuilder, ScanGeometry
from cell.measure.reconstruction.cloud import Cloud
from cell.measure.vision.stripe.profile import StripeProfile

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LINES, ROWS = 300, 480
LINE_STEP, ROW_STEP = 0.25e-3, 0.078e-3
SIGMA = 25e-6
KINDS = ("far", "near", "streak along a line", "streak along a row")
CAMERAS = ((640, 480), (2048, 1088))
"""Pictures in px whose sweeps are timed."""


@dataclass(frozen=True, eq=False)
class Scene:
    """`true` and measured depth (lines, rows) in m over x, y (lines, rows); `sigma` of its noise; `bad` outliers."""

    x: Array
    y: Array
    true: Array
    depth: Array
    sigma: Array
    bad: Mask

    def cloud(self, holes: Mask) -> Cloud:
        """The scene as a cloud that looks down z, with `holes` cut into it."""
        points = np.stack([self.x, self.y, self.depth], axis=-1)
        points[holes | np.isnan(self.depth)] = np.nan
        spread = np.zeros(points.shape, dtype=np.float32)
        spread[:, :, 2] = self.sigma
        lines = len(points)
        none = np.zeros(holes.shape, dtype=np.bool_)
        return Cloud(points, spread, np.zeros((lines, 3)), np.zeros(holes.shape), np.arange(lines, dtype=float), none)


def scene(surface: str, kind: str, share: float, seed: int) -> Scene:
    """A curved or stepped surface with noise, 2 % of its points missing, and a `share` of outliers of one kind.

    far: 2 to 8 mm off; near: 0.28 to 1.5 mm, either side; streaks: whole runs of 20 to 70 points of a line, or of 20 to
    70 lines of a row, 0.28 to 0.8 mm off to one side, each by itself.
    """
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(
        (np.arange(LINES) - LINES / 2) * LINE_STEP, (np.arange(ROWS) - ROWS / 2) * ROW_STEP, indexing="ij"
    )
    if surface == "steps":
        true = 3 * x**2 + 6 * y**2 + 0.0012 * np.tanh((0.97 * x - 0.24 * y - 0.01) / 0.0008)
    else:
        true = 0.0015 * np.sin(150 * x + 70 * y) + 0.0011 * np.sin(230 * y - 90 * x)
    sigma = SIGMA * rng.uniform(0.7, 1.5, x.shape)
    depth = true + sigma * rng.standard_normal(x.shape)
    bad = _places(kind, share, x.shape, rng)
    low, high = {"far": (0.002, 0.008), "near": (0.00028, 0.0015)}.get(kind, (0.00028, 0.0008))
    side = np.where(np.char.startswith(kind, "streak"), 1.0, rng.choice([-1.0, 1.0], x.shape))
    depth[bad] += (rng.uniform(low, high, x.shape) * side)[bad]
    depth[rng.random(x.shape) < 0.02] = np.nan
    return Scene(x, y, true, depth, sigma, bad & np.isfinite(depth))


def _places(kind: str, share: float, shape: tuple[int, int], rng: np.random.Generator) -> Mask:
    bad = np.zeros(shape, dtype=np.bool_)
    if not kind.startswith("streak"):
        return np.asarray(rng.random(shape) < share)
    grid = bad if kind == "streak along a line" else bad.T
    for line in rng.permutation(np.arange(3, grid.shape[0] - 3, 7)):
        if bad.mean() >= share:
            break
        first = rng.integers(5, grid.shape[1] - 80)
        grid[line, first : first + rng.integers(20, 70)] = True
    return bad


def cut_holes(shape: tuple[int, int], size: tuple[int, int], count: int, seed: int) -> Mask:
    """`count` holes of `size` lines × rows at random places off the border."""
    rng = np.random.default_rng(seed)
    holes = np.zeros(shape, dtype=np.bool_)
    for _ in range(count):
        i, j = rng.integers(3, shape[0] - size[0] - 3), rng.integers(3, shape[1] - size[1] - 3)
        holes[i : i + size[0], j : j + size[1]] = True
    return holes


def sweep(lines: int, width: int, rows: int, seed: int) -> tuple[ProfileBuilder, list[StripeProfile]]:
    """A builder for a camera of `width` × `rows` px and the profiles of a sweep over a smooth relief."""
    rng = np.random.default_rng(seed)
    focal = 8e-3 / 4.8e-6 * rows / 480
    camera = CameraModel(width, rows, focal, focal, width / 2, rows / 2, (-0.08, 0.05, 4e-4, -3e-4, 0.0))
    rail = np.array([1.0008, 0.004, -0.003])
    geometry = ScanGeometry(
        camera, LightPlane.of((1.0, 0.01, -1 / 3.5), -0.0351), rail, from_parts((0.09, -0.05, 0.08))
    )
    across = np.arange(rows) * 480 / rows
    none = np.zeros(rows, dtype=np.bool_)
    profiles = []
    for k in range(lines):
        centres = width / 2 + rows / 24 * np.sin(across / 60 + k / 40) + 0.07 * rng.standard_normal(rows)
        level = np.ones(rows)
        profiles.append(StripeProfile("rows", centres, 0.07 * level, 150.0 * level, 2.0 * level, none, none))
    return ProfileBuilder(geometry, lines), profiles


def speed(seed: int, notify: Callable[[float, str], None]) -> dict[str, list[dict[str, float]]]:
    """Milliseconds for each profile, and after the last frame, by camera; `notify` gets the share done and a text."""
    rows = []
    for k, (width, height) in enumerate(CAMERAS):
        notify(k / len(CAMERAS), f"{width}×{height}")
        builder, profiles = sweep(LINES, width, height, seed)
        begun = time.perf_counter()
        for profile in profiles:
            builder.see(profile)
        seen = time.perf_counter() - begun
        flanges, spread = np.tile(np.eye(4), (LINES, 1, 1)), np.full((LINES, 3), 1e-5)
        wall, processor = [], []
        # The first compiles.
        for _ in range(4):
            begun, cpu = time.perf_counter(), time.process_time()
            cloud = builder.place(np.arange(LINES), flanges, np.linspace(0.02, 0.08, LINES), spread)
            wall.append(time.perf_counter() - begun)
            processor.append(time.process_time() - cpu)
        rows.append(
            {
                "width": width,
                "rows": height,
                "lines": LINES,
                "points": cloud.size,
                "ms_per_profile": 1e3 * seen / LINES,
                "ms_after_last_frame": 1e3 * min(wall),
                "processor_ms_after_last_frame": 1e3 * min(processor),
            }
        )
    return {"speed": rows}


def swept(
    geometry: ScanGeometry, profiles: Iterable[tuple[StripeProfile, float]], rail_sigma: float,
    base_from_flange: pin.SE3, least_points: int = 500,
) -> Cloud:  # fmt: skip
    """The cloud of profiles, each with the rail's reading ± `rail_sigma`, m, in the rail's order; the flange stood
    still all along. Raises `RefusedError` when fewer than `least_points` points are left."""
    builder, readings = ProfileBuilder(geometry, 2), []
    for profile, reading in profiles:
        builder.see(profile)
        readings.append(reading)
    rail = np.array(readings, dtype=np.float64)
    order = np.argsort(rail, kind="stable")
    flanges = np.broadcast_to(base_from_flange.homogeneous, (len(rail), 4, 4))
    spread = np.full((len(rail), 1), rail_sigma) * builder.sweep_direction(base_from_flange)
    return builder.place(order, flanges, rail[order], spread).require(least_points)
