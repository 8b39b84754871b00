"""The picture of a proposed job: the surface and what its sweeps see of it, a cut across it, the arm at the place.

Lengths in mm. Drawn before anything moves, from the drawing alone.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.spatial import ConvexHull, cKDTree

from cell.apps.new_job.proposal import SEEN_WITHIN, Proposal
from cell.apps.new_job.sweeps import Array, SeenSurface
from cell.check.reach import nominal_scan, station_planner
from cell.config.cell_config import CellConfig
from cell.config.job import SwathSection
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface
from cell.motion.collision import Body, CollisionError
from cell.motion.kinematics import HOME, Unreachable
from cell.procedures.arm.photograph import base_from_place_at_target, scan_plans

COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:purple", "tab:brown", "tab:olive", "tab:cyan", "tab:pink")
PLACES = 6000
"""Places drawn evenly over the surface, at which it is looked whether they are seen."""
SHADES = {"part": "tab:red", "surface": "tab:green", "table": "0.75", "board": "tab:blue", "scan head": "tab:orange",
          "target camera": "tab:purple", "deck": "0.6"}  # fmt: skip


def draw_proposal(path: Path, made: Proposal, nominal: NominalSurface, config: CellConfig, title: str) -> None:
    """Draw it to a PNG."""
    figure = Figure(figsize=(18.0, 11.0), dpi=90)
    figure.suptitle(title)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.15, 1.0], left=0.05, right=0.98, bottom=0.06, top=0.91,
                               wspace=0.14, hspace=0.3)  # fmt: skip
    _draw_map(figure, figure.add_subplot(grid[0, 0]), made, nominal)
    _draw_cut(figure.add_subplot(grid[1, 0]), made)
    above, beside = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    _draw_cell(above, beside, made, config, nominal)
    figure.savefig(path)


def _draw_map(figure: Figure, axes: Axes, made: Proposal, nominal: NominalSurface) -> None:
    """The surface from above by its height, what no sweep sees of it in red, the strips of the sweeps, the part."""
    corners = 1e3 * nominal.vertices[nominal.triangles]
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    shown = PolyCollection(
        list(corners[order][:, :, :2]), array=corners[order][:, :, 2].mean(axis=1), cmap="viridis", edgecolors="face",
        linewidths=0.3,
    )  # fmt: skip
    axes.add_collection(shown)
    shares = nominal.areas[nominal.sample_triangles] / np.bincount(nominal.sample_triangles)[nominal.sample_triangles]
    drawn = np.random.default_rng(0).choice(len(nominal.samples), PLACES, p=shares / shares.sum())
    samples = nominal.samples[drawn]
    points = np.concatenate([each.points[each.valid] for each in made.seen])
    missed = np.asarray(cKDTree(points).query(samples, distance_upper_bound=SEEN_WITHIN)[0] > SEEN_WITHIN)
    hidden = 1e3 * samples[missed]
    axes.scatter(hidden[:, 0], hidden[:, 1], color="tab:red", s=3, linewidths=0, label="not seen by any sweep")
    for k, each in enumerate(made.seen):
        axes.plot(*1e3 * _outline(each).T, color=COLOURS[k % len(COLOURS)], linewidth=1.6)
    x, y, _ = 1e3 * np.array(made.job.grasp.size)
    where = 1e3 * made.job.place.surface_from_part.se3().translation
    axes.add_patch(
        Rectangle(
            (where[0] - x / 2, where[1] - y / 2), x, y, fill=False, linestyle=":", edgecolor="k", label="the part"
        )
    )
    axes.autoscale()
    axes.set_aspect("equal")
    axes.set_xlabel("x of the surface in mm, the way of the sweeps →")
    axes.set_ylabel("y in mm")
    axes.set_title(f"from above: {100 * (1 - float(missed.mean())):.0f} % of the surface is seen", fontsize="medium")
    axes.legend(fontsize=7, loc="lower left")
    figure.colorbar(shown, ax=axes, label="height in mm", shrink=0.8, pad=0.02)


def _outline(seen: SeenSurface) -> Array:
    """Around what a sweep sees, (n, 2) m, closed."""
    points = seen.points[seen.valid][:, :2]
    if len(points) < 4:
        return np.empty((0, 2))
    hull = points[ConvexHull(points).vertices]
    return np.vstack([hull, hull[:1]])


def _draw_cut(axes: Axes, made: Proposal) -> None:
    """Across the sweeps: the surface's points, and from where each sweep's camera looks at them."""
    for k, each in enumerate(made.seen):
        colour = COLOURS[k % len(COLOURS)]
        axes.plot([], [], color=colour, label=_sweep_words(k, made.job.scan.swath[k]))
        middle = len(each.rail) // 2
        points = each.points[each.valid]
        some = 1e3 * points[:: max(1, len(points) // 3000)]
        axes.plot(some[:, 1], some[:, 2], ",", color=colour)
        line = each.points[middle][np.isfinite(each.points[middle][:, 0])]
        if len(line):
            eye = each.eyes[middle]
            for end in (line[np.argmin(line[:, 1])], line[np.argmax(line[:, 1])]):
                axes.plot(*1e3 * np.array([eye[1:], end[1:]]).T, color=colour, linewidth=0.9)
            axes.plot(*1e3 * eye[1:], "s", color=colour)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("y of the surface in mm")
    axes.set_ylabel("height in mm")
    scan = made.job.scan
    axes.set_title(
        f"across the sweeps: camera {1e3 * scan.stand_off:.0f} mm above z = 0, {len(scan.swath)} × "
        f"{1e3 * scan.length:.0f} mm by the {scan.mode}, lines {1e3 * scan.speed / scan.frame_rate:.2f} mm apart",
        fontsize="medium",
    )
    axes.legend(fontsize=7, loc="upper left")


def _sweep_words(k: int, swath: SwathSection) -> str:
    tilts = (("roll", swath.roll), ("pitch", swath.pitch))
    tilt = "".join(f", {name} {np.degrees(angle):.0f}°" for name, angle in tilts if angle)
    return f"sweep {k + 1}: {1e3 * swath.across:+.1f} mm across{tilt}"


def _draw_cell(above: Axes, beside: Axes, made: Proposal, config: CellConfig, nominal: NominalSurface) -> None:
    """The bodies of the collision check in the arm's base, with the arm at the first sweep."""
    job = made.job
    planner = station_planner(job, config, nominal.extent)
    surface = base_from_place_at_target(config, job) * job.surface.place_from_surface.se3()
    plan = scan_plans(config, job, surface, nominal_scan(config))[0]
    try:
        joints, where = planner.reach(plan.base_from_flange, HOME, "the scan pose"), "at the first sweep"
    except (Unreachable, CollisionError):
        joints, where = HOME, "folded: the first sweep is out of reach"
    placed = planner.collisions.placed(joints)
    for axes, (first, second), title in ((above, (0, 1), "from above"), (beside, (0, 2), "from the side")):
        for body in placed:
            hull = 1e3 * _silhouette(body, first, second)
            colour = SHADES.get(body.name, "0.4")
            label = body.name if body.name in SHADES else None
            axes.add_collection(PolyCollection([hull], facecolor=colour, edgecolor="0.2", alpha=0.45, label=label))
            axes.update_datalim(hull)
        axes.autoscale_view()
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x of the arm's base in mm")
        axes.set_ylabel("y in mm" if second == 1 else "z in mm")
        axes.set_title(f"{title}, the arm {where}", fontsize="medium")
    beside.legend(fontsize=7, loc="upper right")


def _silhouette(body: Body, first: int, second: int) -> Array:
    """Corners (n, 2) m around a body as seen along the third axis."""
    corners = np.array(list(product(*((-h, h) for h in 0.5 * np.array(body.size)))))
    points = transform(body.placement, corners)
    if body.radius is not None:
        angles = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
        circle = np.zeros((24, 3))
        circle[:, first], circle[:, second] = body.radius * np.cos(angles), body.radius * np.sin(angles)
        points = (points[:, None] + circle).reshape(-1, 3)
    flat = points[:, [first, second]]
    made: Array = flat[ConvexHull(flat).vertices]
    return made
