"""Whether what the claw holds is in the way of light and sight: of the scan, and of the board's photograph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.apps.new_job.rays import Array
from cell.apps.new_job.sweeps import SeenSurface
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.config.mounting import mounted
from cell.measure.geometry.poses import transform
from cell.measure.vision import parse_board
from cell.motion.bodies import Body, tool_bodies
from cell.procedures.arm.camera_poses import base_from_place_at_target, look_pose, photo_pose

MOST_HIDDEN = 0.02
"""Share of the scanned points that may be hidden behind what the claw holds."""
MARGIN = 0.002
"""How much larger the part is taken to be on each side, m."""


def sight_problems(job: Job, config: CellConfig, seen: Sequence[SeenSurface]) -> Iterator[str]:
    """A line for each view that the part in the claw, as drawn, hides."""
    part = tool_bodies(job.grasp.size, job.grasp.flange_from_part.se3(), mounted(config))[-1]
    sides = " x ".join(f"{1e3 * side:g}" for side in job.grasp.size)
    held = f"the part in the claw ({sides} mm, grasp.size)"
    hidden = [_hidden_share(each, part) for each in seen]
    if hidden and max(hidden) > MOST_HIDDEN:
        yield (
            f"sweep {int(np.argmax(hidden)) + 1}: {held} hides {100 * max(hidden):.0f} % of it from the scan camera or "
            f"the laser (allowed: {100 * MOST_HIDDEN:g} %); give the part's own size with --part-size, or hold it "
            "otherwise with --grasp"
        )
    board = parse_board(job.board.spec)
    base_from_place = base_from_place_at_target(config, job)
    hand = config.target_camera.flange_from_camera.se3()
    base_from_board = base_from_place * job.place_from_board
    for what, flange in (
        ("while the vehicle drives", look_pose(config, job, board, hand)),
        ("in the photograph", photo_pose(job, board, base_from_board, hand)),
    ):
        points = transform(flange.inverse() * base_from_board, board.points())
        eyes = np.tile(hand.translation, (len(points), 1))
        if (count := int(_crosses(eyes, points, part).sum())) > 0:
            yield (
                f"{held} hides {count} of {len(points)} points of the board from the target camera {what}; give the "
                "part's own size with --part-size, or hold it otherwise with --grasp"
            )
            return


def _hidden_share(seen: SeenSurface, part: Body) -> float:
    lines, rows = seen.valid.nonzero()
    if not len(lines):
        return 0.0
    every = max(1, len(lines) // 4000)
    lines, rows = lines[::every], rows[::every]
    flanges = seen.flanges[lines]

    def on_flange(points: Array) -> Array:
        return np.asarray(np.einsum("nji,nj->ni", flanges[:, :3, :3], points - flanges[:, :3, 3]))

    points = on_flange(seen.points[lines, rows])
    hidden = _crosses(on_flange(seen.eyes[lines]), points, part) | _crosses(on_flange(seen.lamps[lines]), points, part)
    return float(hidden.mean())


def _crosses(starts: Array, ends: Array, body: Body) -> NDArray[np.bool_]:
    """(n,) whether the way from start to end, flange frame, leads through the box."""
    into: pin.SE3 = body.placement.inverse()
    a, b = transform(into, starts), transform(into, ends)
    half = 0.5 * np.array(body.size) + MARGIN
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half - a) / (b - a), (half - a) / (b - a)
    enter = np.nanmax(np.minimum(first, second), axis=1)
    leave = np.nanmin(np.maximum(first, second), axis=1)
    return np.asarray((enter < leave) & (leave > 0.0) & (enter < 1.0))
