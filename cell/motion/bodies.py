"""The solids that must not touch: capsules of the arm, boxes of the tool, the part, the vehicle and the station.

Each body hangs on the arm's base (fixed), on one of the six joints or on the flange. Sizes are generous on purpose;
poses come from the configuration, the job and the measured pose of the board.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from cell.motion.arm_models import MODELS

BASE = 0
"""Parent of what stands still: poses are in the arm's base frame."""
FLANGE = 7
"""Parent of what the flange carries: poses are in the flange frame. 1 … 6 are the frames that turn with a joint."""


PLACED = "placed part"
"""The part once it was let go: it stands still."""
TOUCHES = (("part", "surface"), ("part", "table"), ("claw", "surface"), ("claw", PLACED))
"""What comes near on purpose while the part is set down and left."""


@dataclass(frozen=True)
class Body:
    """A box (`size` x, y, z) or, when `radius` is given, a capsule along its z axis with a core of length `size[2]`."""

    name: str
    parent: int
    placement: pin.SE3
    size: tuple[float, float, float]
    radius: float | None = None


def box(name: str, parent: int, placement: pin.SE3, size: Sequence[float]) -> Body:
    """A box centred at `placement` with edge lengths `size` (3), m."""
    if len(size) != 3 or not all(s > 0 for s in size):
        raise ValueError(f"size of the box {name!r} is {tuple(size)} m; three lengths greater than 0 are needed")
    return Body(name, parent, placement, (float(size[0]), float(size[1]), float(size[2])))


def block(name: str, parent: int, low: Sequence[float], high: Sequence[float]) -> Body:
    """A box with edges along its parent's axes from corner `low` to corner `high` (3), m."""
    lower, upper = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    return box(name, parent, pin.SE3(np.eye(3), (lower + upper) / 2), [float(v) for v in upper - lower])


def capsule(name: str, parent: int, start: Sequence[float], end: Sequence[float], radius: float) -> Body:
    """A capsule around the segment from `start` to `end` (3), m."""
    p, q = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    length = float(np.linalg.norm(q - p))
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), (q - p) / length)
    return Body(name, parent, pin.SE3(turn.toRotationMatrix(), (p + q) / 2), (0.0, 0.0, length), radius)


def arm_bodies(model: str = "UR10e") -> list[Body]:
    """Capsules around the links of an arm, in the frames that turn with its joints (z along the joint's axis)."""
    arm = MODELS[model]
    (beside, thick), (fore, slim) = arm.upper, arm.forearm
    return [
        capsule("base", BASE, (0, 0, 0.3 * arm.base), (0, 0, 0.8 * arm.base), arm.base),
        capsule("shoulder", 1, (0, 0, arm.d1 - 0.25 * thick), (0, -0.68 * beside, arm.d1), 1.1 * thick),
        capsule("shoulder joint", 2, (0, 0, beside - 0.4 * thick), (0, 0, beside + 0.5 * thick), thick),
        capsule("upper arm", 2, (0, 0, beside), (arm.a2, 0, beside), thick),
        capsule("elbow", 3, (0, 0, fore), (0, 0, beside + 0.5 * thick), thick),
        capsule("forearm", 3, (0, 0, fore), (arm.a3, 0, fore), slim),
        capsule("wrist 1", 4, (0, 0, fore + 0.01), (0, 0, arm.d4 + 0.01), arm.wrist),
        capsule("wrist 2", 5, (0, 0, 0), (0, 0, arm.d5 + 0.01), arm.wrist),
        capsule("wrist 3", 6, (0, 0, 0.03), (0, 0, arm.d6 - 0.036), 0.9 * arm.wrist),
    ]


_ACROSS = pin.SE3(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))


@dataclass(frozen=True)
class Mounted:
    """What the flange carries beside the claw: flange_from_camera of both cameras, the scan camera's with the carriage
    at 0, the laser's `baseline` and the rail's `travel`, m. The carriage runs along the scan camera's x axis."""

    scan: pin.SE3 = field(default_factory=lambda: pin.SE3(_ACROSS.rotation, np.array([0.09, -0.05, 0.08])))
    target: pin.SE3 = field(default_factory=lambda: pin.SE3(_ACROSS.rotation, np.array([-0.10, 0.0, 0.03])))
    baseline: float = 0.035
    travel: tuple[float, float] = (0.0, 0.100)


def tool_bodies(
    part_size: Sequence[float] | None = None,
    flange_from_part: pin.SE3 | None = None,
    mounted: Mounted | None = None,
) -> list[Body]:
    """Claw, rail with the scan head over its whole travel, target camera, and the part when it is held.

    The part's frame has its origin in the mating face, z into the part; `part_size` is its extent along its x, y, z.
    Without `mounted`, cameras and rail are those of the configuration that ships.
    """
    on = mounted or Mounted()
    first, last = min(0.0, on.travel[0]), max(0.0, on.travel[1])
    bodies = [
        block("claw", FLANGE, (-0.03, -0.03, 0.0), (0.03, 0.03, 0.145)),
        _on_camera("scan head", on.scan, (first - on.baseline - 0.025, -0.025, -0.06), (last + 0.03, 0.025, 0.01)),
        _on_camera("target camera", on.target, (-0.025, -0.025, -0.06), (0.025, 0.025, 0.02)),
    ]
    if part_size is not None:
        x, y, z = part_size
        placement = (flange_from_part or pin.SE3.Identity()) * pin.SE3(np.eye(3), np.array([0.0, 0.0, z / 2]))
        bodies.append(box("part", FLANGE, placement, (x, y, z)))
    return bodies


def _on_camera(name: str, flange_from_camera: pin.SE3, low: Sequence[float], high: Sequence[float]) -> Body:
    """A box with edges along a camera's axes; along the flange's own where those are the same lines."""
    turn = flange_from_camera.rotation
    if np.abs(turn - turn.round()).max() < 1e-9:
        ends = np.array([turn.round() @ corner + flange_from_camera.translation for corner in (low, high)]).round(9)
        return block(name, FLANGE, ends.min(axis=0).tolist(), ends.max(axis=0).tolist())
    local = block(name, FLANGE, low, high)
    return box(name, FLANGE, flange_from_camera * local.placement, local.size)


def vehicle_bodies(plates: Sequence[tuple[str, pin.SE3, Sequence[float]]] = ()) -> list[Body]:
    """The vehicle's deck below the arm and the calibration plates on it: name, base_from_centre, size (x, y, z)."""
    deck = block("deck", BASE, (-0.80, -0.40, -0.30), (0.20, 0.40, -0.005))
    return [deck, *(box(name, BASE, pose, size) for name, pose, size in plates)]


def station_bodies(
    base_from_place: pin.SE3,
    place_from_board_centre: pin.SE3,
    place_from_surface: pin.SE3 | None = None,
    surface_extent: tuple[Sequence[float], Sequence[float]] = ((-0.035, -0.018, 0.0), (0.035, 0.018, 0.015)),
) -> list[Body]:
    """Table, nominal surface, board and its post, placed by the measured pose of the place frame in the arm base.

    `surface_extent` are the lowest and the highest corner of the surface in its own frame, m.
    """

    def placed(name: str, low: Sequence[float], high: Sequence[float]) -> Body:
        local = block(name, BASE, low, high)
        return box(name, BASE, base_from_place * local.placement, local.size)

    (x, y, z), over = surface_extent
    surface = block("surface", BASE, (x, y, z - 0.002), over)
    on_place = (place_from_surface or pin.SE3.Identity()) * surface.placement
    cx, cy, cz = place_from_board_centre.translation
    board = base_from_place * place_from_board_centre * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.006]))
    return [
        placed("table", (-0.35, -0.50, -0.60), (0.45, 0.50, -0.002)),
        box("surface", BASE, base_from_place * on_place, surface.size),
        placed("board post", (cx, cy - 0.02, -0.002), (cx + 0.04, cy + 0.02, cz)),
        box("board", BASE, board, (0.21, 0.17, 0.01)),
    ]
