"""How good a calibration is, beyond its χ²: coverage, residuals, what limits it at the job's points, what to add.

It is made from adjustments and observations: of a calibration just made or of an archived one. A run never asks for it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cell.config.calibrations.store import Solved
from cell.config.cell_config import CellConfig
from cell.config.job import Job, load_job
from cell.measure.calibration.archive import Observations
from cell.measure.calibration.judge.checks import joint_checks
from cell.measure.calibration.judge.coverage import GRID, Coverage, Places, advice, derivatives, influences, place_rms
from cell.measure.calibration.solve.joint import Joint
from cell.measure.calibration.solve.results import ScanCalibration
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface
from cell.procedures.arm.photograph import base_from_place_at_target, scan_plans
from cell.procedures.part_error import part_points

SHOWN_PARAMETERS = 14


def camera_picture(path: Path, seen: Coverage, title: str) -> None:
    """Residuals of dots and stripe over the picture, number of dots in each part of it, and the views' geometry."""
    figure = Figure(figsize=(13.5, 9.6), dpi=110, layout="constrained")
    figure.suptitle(f"{title}: {len(seen.depth)} views, {len(seen.dots)} dots, {len(seen.stripe)} stripe points")
    axes = figure.subplots(2, 2)
    _dots(figure, axes[0, 0], seen)
    _field(figure, axes[0, 1], seen)
    if len(seen.stripe):
        _stripe(figure, axes[1, 0], seen)
    else:
        _histogram(axes[1, 0], seen)
    _views(figure, axes[1, 1], seen)
    figure.savefig(path)


def influence_picture(path: Path, influence: Mapping[str, Any], advice: list[dict[str, Any]]) -> None:
    """Bars: what each parameter's deviation does at the job's points, and what further views or less noise would do."""
    figure = Figure(figsize=(14.5, 6.4), dpi=110, layout="constrained")
    total = float(influence["total_mm"])
    figure.suptitle(
        f"what the calibration leaves uncertain at the job's {influence['points']} points: {total:.4f} mm RMS, 1 sigma"
    )
    left, right = figure.subplots(1, 2)
    rows = influence["parameters"][:SHOWN_PARAMETERS]
    places = np.arange(len(rows))
    left.barh(places - 0.2, [r["alone_mm"] for r in rows], 0.4, color="tab:blue", label="its deviation alone")
    left.barh(places + 0.2, [r["if_known_mm"] for r in rows], 0.4, color="silver", label="total if it were known")
    left.axvline(total, color="black", linestyle="--", linewidth=1, label="total")
    left.set_yticks(places, [r["name"] for r in rows])
    left.set_xscale("log")
    left.set_xlabel("mm RMS over the points (log)")
    left.set_title("parameters; known together better than apart, so the blue bars do not add up")
    left.invert_yaxis()
    left.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=3)
    places = np.arange(len(advice))
    colours = ["tab:green" if row["kind"] == "views" else "tab:orange" for row in advice]
    right.barh(places, [row["then_mm"] for row in advice], 0.6, color=colours)
    for place, row in zip(places, advice, strict=True):
        right.text(1.01 * total, place, f" {100 * row['gain']:.0f} % less", va="center", fontsize=8)
    right.axvline(total, color="black", linestyle="--", linewidth=1)
    right.set_yticks(places, [row["what"] for row in advice], fontsize=8)
    right.set_xlim(0, 1.2 * total)
    right.set_xlabel("mm RMS over the points that would be left")
    right.set_title("what to add: views (green), less noise (orange)")
    right.invert_yaxis()
    figure.savefig(path)


def _dots(figure: Figure, axes: Axes, seen: Coverage) -> None:
    size = np.linalg.norm(seen.dots_off, axis=1)
    rms = float(np.sqrt(np.mean(seen.dots_off**2)))
    shown = axes.scatter(
        seen.dots[:, 0], seen.dots[:, 1], c=size, s=5, cmap="viridis", vmin=0, vmax=3 * rms, linewidths=0
    )
    means = seen.cell_means()
    width, height = seen.size
    x, y = np.meshgrid((np.arange(GRID[0]) + 0.5) * width / GRID[0], (np.arange(GRID[1]) + 0.5) * height / GRID[1])
    axes.quiver(
        x, y, means[..., 0], means[..., 1], angles="xy", scale_units="xy", scale=rms / (width / GRID[0]), color="red",
        width=0.004,
    )  # fmt: skip
    _frame(axes, seen, f"dots: {rms:.4f} px RMS; arrows: mean of a cell, as long as a cell is wide for {rms:.4f} px")
    figure.colorbar(shown, ax=axes, label="length of a residual in px", shrink=0.85)


def _field(figure: Figure, axes: Axes, seen: Coverage) -> None:
    counts = seen.counts(seen.dots)
    width, height = seen.size
    shown = axes.imshow(counts, extent=(0, width, height, 0), cmap="Greens", vmin=0, vmax=max(1.0, float(counts.max())))
    for row in range(GRID[1]):
        for column in range(GRID[0]):
            at = ((column + 0.5) * width / GRID[0], (row + 0.5) * height / GRID[1])
            dark = counts[row, column] > 0.6 * counts.max()
            axes.text(
                *at, f"{counts[row, column]:.0f}", ha="center", va="center", fontsize=8,
                color="white" if dark else "black",
            )  # fmt: skip
    covered = seen.summary()["field_covered"]
    _frame(axes, seen, f"dots in each part of the picture: {100 * covered:.0f} % covered")
    figure.colorbar(shown, ax=axes, label="dots", shrink=0.85)


def _stripe(figure: Figure, axes: Axes, seen: Coverage) -> None:
    rms = float(np.sqrt(np.mean(seen.stripe_off**2)))
    span = 3 * rms
    shown = axes.scatter(
        seen.stripe[:, 0], seen.stripe[:, 1], c=seen.stripe_off, s=6, cmap="coolwarm", vmin=-span, vmax=span,
        linewidths=0,
    )  # fmt: skip
    low, high = 1e3 * seen.stripe_depth.min(), 1e3 * seen.stripe_depth.max()
    _frame(axes, seen, f"stripe: residuals, {rms:.4f} px RMS, depths {low:.0f} to {high:.0f} mm")
    figure.colorbar(shown, ax=axes, label="residual across the stripe in px", shrink=0.85)


def _histogram(axes: Axes, seen: Coverage) -> None:
    rms = float(np.sqrt(np.mean(seen.dots_off**2)))
    edges = np.linspace(-4 * rms, 4 * rms, 61)
    for k, axis in enumerate("xy"):
        axes.hist(seen.dots_off[:, k], edges.tolist(), histtype="step", label=f"{axis}, {len(seen.dots)} dots")
    middle = 0.5 * (edges[1:] + edges[:-1])
    bell = len(seen.dots) * (edges[1] - edges[0]) / (rms * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (middle / rms) ** 2)
    axes.plot(middle, bell, color="black", linewidth=1, linestyle="--", label=f"Gaussian, {rms:.4f} px")
    axes.set_title("dots: how the residuals are spread")
    axes.set_xlabel("residual in px")
    axes.set_ylabel("dots")
    axes.legend(fontsize=8)


def _views(figure: Figure, axes: Axes, seen: Coverage) -> None:
    tilt = np.degrees(seen.tilt)
    travels = float(np.ptp(seen.rail)) > 1e-3
    depth = 1e3 * seen.depth
    shown = axes.scatter(tilt[:, 0], tilt[:, 1], c=depth, s=70, cmap="plasma", edgecolors="black", linewidths=0.5)
    if travels:
        for (x, y), rail in zip(tilt, seen.rail, strict=False):
            axes.annotate(f"{1e3 * rail:.0f}", (x, y), textcoords="offset points", xytext=(7, 5), fontsize=7)
    most = 1.25 * max(5.0, float(np.abs(tilt).max()))
    axes.set_xlim(-most, most)
    axes.set_ylim(-most, most)
    axes.grid(alpha=0.3)
    axes.set_xlabel("tilt of the board about the picture's x in deg")
    axes.set_ylabel("about its y in deg")
    axes.set_title("views: tilts and depths" + ("; figures: rail position in mm" if travels else ""))
    figure.colorbar(shown, ax=axes, label="depth of the board's middle in mm", shrink=0.85)


def _frame(axes: Axes, seen: Coverage, title: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlim(0, seen.size[0])
    axes.set_ylim(seen.size[1], 0)
    axes.set_aspect("equal")
    axes.set_xlabel("column in px")
    axes.set_ylabel("row in px")


@dataclass(frozen=True, eq=False)
class Examination:
    """The figures as JSON has them, and what the pictures are drawn from."""

    summary: dict[str, Any]
    scan: Coverage
    target: Coverage

    def draw(self, folder: Path) -> list[Path]:
        """Draw the pictures into a folder, which is made; their paths."""
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / f"{name}.png" for name in ("scan_camera", "target_camera", "place_error")]
        camera_picture(paths[0], self.scan, "scan camera")
        camera_picture(paths[1], self.target, "target camera")
        influence_picture(paths[2], self.summary["influence"], self.summary["advice"])
        return paths


def examine(solved: Solved, observations: Observations, config: CellConfig, job: str | Path) -> Examination:
    """Coverage and residuals of both cameras; what limits the 45 points of a job, and what would better them."""
    loaded, mesh = load_job(job)
    nominal = NominalSurface.load(mesh, unit=loaded.surface.mesh_unit)
    places = places_of_job(config, loaded, nominal, solved.calibration.scan)
    adjusted = solved.scan.adjusted
    state, covariance = adjusted.state, adjusted.reliable_covariance
    by_parameter = derivatives(state, covariance, places)
    board = next(o.view.spec for o in observations.scan if o.view is not None)
    scan, target = Coverage.of(solved.scan), Coverage.of(solved.target)
    summary = {
        "scan_coverage": scan.summary(),
        "target_coverage": target.summary(),
        "noise_found": noise_found(solved.scan),
        "checks": [
            {"camera": camera, **check.as_dict()}
            for camera, joint, nominal in (
                ("scan", solved.scan, observations.scan_camera),
                ("target", solved.target, observations.target_camera),
            )
            for check in joint_checks(joint, nominal)
        ],
        "influence": influences(by_parameter, covariance),
        "advice": advice(
            solved.scan, board, config.rail.travel, lambda other: place_rms(by_parameter, np.asarray(other))
        ),
    }
    return Examination(summary, scan, target)


def places_of_job(config: CellConfig, job: Job, nominal: NominalSurface, scan: ScanCalibration) -> Places:
    """The job's 45 points as the sweep sees them when vehicle, board and surface are where they should be."""
    base_from_surface = base_from_place_at_target(config, job) * job.surface.place_from_surface.se3()
    plan = scan_plans(config, job, base_from_surface, scan)[0]
    in_base = transform(base_from_surface, transform(job.place.surface_from_part.se3(), part_points(nominal)))
    in_flange = transform(plan.base_from_flange.inverse(), in_base)
    at_home = transform(scan.flange_from_camera.inverse(), in_flange)
    # The carriage stands where the light plane goes through the point.
    normal = scan.light_plane.n
    rails = (at_home @ normal - scan.light_plane.distance) / float(scan.rail_direction @ normal)
    return Places(scan.camera.project(at_home - rails[:, None] * scan.rail_direction), rails, plan.base_from_flange)


def noise_found(joint: Joint) -> dict[str, float]:
    """The noise that the residuals speak of, as multiples of what dots and stripe state, and χ²/dof."""
    priors = joint.adjusted.priors
    return {"dots": priors.dots_scale, "stripe": priors.stripe_scale, "chi2_per_dof": joint.adjusted.chi2_per_dof}
