"""Whether putting the part down makes sense: force, speed, accuracy and height, by the job's own mesh, claw and arm."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh

from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.makes.records import MOST_PAYLOAD
from cell.measure.inversion.nominal import read_mesh

G = 9.81
REACTION_S = 0.05
"""From the touch until the arm stands: state packet, two set points, servoJ's look-ahead and the stop."""
LEAST_OVER = 0.5
"""Share of the part's footprint that lies over the surface, at least."""
GRID = 21
"""Rays to the side over the footprint."""
FAR_M = 1.0


def contact_problems(job: Job, config: CellConfig, mesh: Path) -> Iterator[str]:
    """What of `place`, `grasp` and `scan.exposure` cannot end well, each with its value and what is allowed."""
    place, grasp, arm = job.place, job.grasp, config.arm
    left = G * (MOST_PAYLOAD[arm.model] - arm.payload) if arm.model in MOST_PAYLOAD else np.inf
    if place.contact_force > left:
        yield (
            f"place.contact_force {place.contact_force:g} N is more than a {arm.model} may carry beside arm.payload, "
            f"{arm.payload:g} kg (allowed: 2 to {left:.0f} N)"
        )
    fastest = place.tolerance / REACTION_S
    if place.contact_speed > fastest:
        yield (
            f"place.contact_speed {1e3 * place.contact_speed:g} mm/s: after the touch the arm goes on by "
            f"{1e3 * place.contact_speed * REACTION_S:.2g} mm, more than place.tolerance (allowed: at most "
            f"{1e3 * fastest:.3g} mm/s)"
        )
    scatter = np.hypot(grasp.sigma, np.sqrt(2) * arm.repeatability)
    turning = np.hypot(grasp.sigma_angle, np.sqrt(2) * arm.repeatability_angle)
    for key, least, asked, unit in (
        ("tolerance", scatter, place.tolerance, "mm"),
        ("tolerance_angle", turning, place.tolerance_angle, "mrad"),
    ):
        if least > asked:
            sigma = "grasp.sigma" if unit == "mm" else "grasp.sigma_angle"
            yield (
                f"place.{key} {1e3 * asked:g} {unit} cannot be kept: {sigma} and the arm's repeatability alone leave "
                f"{1e3 * least:.3g} {unit} open, one standard deviation (allowed: more than that)"
            )
    if place.contact_travel < 3 * grasp.sigma:
        yield (
            f"place.contact_travel {1e3 * place.contact_travel:g} mm is less than three times grasp.sigma: the part "
            f"would often not touch within it (allowed: at least {3e3 * grasp.sigma:g} mm)"
        )
    if (blur := job.scan.exposure * job.scan.speed) > 0.5 * place.tolerance:
        yield (
            f"scan.exposure {1e3 * job.scan.exposure:g} ms at scan.speed {1e3 * job.scan.speed:g} mm/s smears a line "
            f"by {1e3 * blur:.3g} mm (allowed: half of place.tolerance, {500 * place.tolerance:g} mm)"
        )
    yield from _height_problems(job, *under_part(job, mesh))


def _height_problems(job: Job, over: float, highest: float) -> Iterator[str]:
    height = job.grasp.size[2]
    if over < LEAST_OVER:
        yield (
            f"place.surface_from_part: {100 * over:.0f} % of the part's footprint lie over the surface (allowed: at "
            f"least {100 * LEAST_OVER:.0f} %); correct the pose, grasp.size or the mesh's origin"
        )
    elif highest < -job.place.contact_travel:
        yield (
            f"place.surface_from_part: the surface lies {-1e3 * highest:.3g} mm below the part's lowest plane, beyond "
            f"place.contact_travel, {1e3 * job.place.contact_travel:g} mm: the part would be let go of in the air. "
            "Lower it"
        )
    elif highest > height:
        yield (
            f"place.surface_from_part: the surface goes through the whole part, {1e3 * highest:.3g} mm into its box of "
            f"{1e3 * height:g} mm (grasp.size). Raise it"
        )


def contact_notes(job: Job, mesh: Path) -> Iterator[str]:
    """What a person should know of the place before the first part."""
    over, highest = under_part(job, mesh)
    yield (
        f"at the place the surface reaches {1e3 * highest:.1f} mm into the part's box of "
        f"{1e3 * job.grasp.size[2]:g} mm, and {100 * over:.0f} % of its footprint lie over the surface"
    )


def under_part(job: Job, mesh: Path) -> tuple[float, float]:
    """Share of the part's footprint over the nominal surface, and how far the surface rises there above the part's
    lowest plane, m; (0, -inf) where nothing is under it. The part is its box `grasp.size`, upwards from its origin."""
    vertices, triangles = read_mesh(mesh, job.surface.mesh_unit)
    pose = job.place.surface_from_part.se3()
    body = trimesh.Trimesh((vertices - pose.translation) @ pose.rotation, triangles, process=False)
    # A little off the edges, which a ray may miss.
    across, along = (0.999 * np.linspace(-0.5, 0.5, GRID) * side for side in job.grasp.size[:2])
    starts = np.array([(x, y, FAR_M) for x in across for y in along])
    hits, rays, _ = body.ray.intersects_location(starts, np.tile([0.0, 0.0, -1.0], (len(starts), 1)))
    if not len(hits):
        return 0.0, -np.inf
    return len(np.unique(rays)) / len(starts), float(hits[:, 2].max())
