"""The part and what it touches: held by the claw, pressed onto the surface, released and resting there.

The part's underside is the nominal surface itself, or that of the part's own mesh. Contact is a penalty: each sample
point of the underside below the true surface pushes back along the surface's normal. A part with a mesh of its own
settles once it is let go: its weight turns it until it rests on three points. Friction is left out.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from sim_backends.world import drawing
from sim_backends.world.bodies.surfaces import Surface
from sim_backends.world.drawing import inverse
from sim_backends.world.scene import rotation

Pose = NDArray[np.float64]
Vector = NDArray[np.float64]

STIFFNESS = 20e3
"""Vertical stiffness of a flat contact over the whole underside, N/m."""
GRIP_REACH = 0.005
"""How far, m, the claw may be from the part's place in it and still grip it."""
GRIP_TURN = 0.3
"""How far, rad, the claw may be turned against the part and still grip it."""
FINGERS_ABOVE = 0.015
"""The fingertips end this far, m, from the part's underside."""
LEAST_TOUCHING = 40
"""Of the points of a part's underside that are tried so many have to have a surface below them."""
CLEARANCE, CLEARANCE_STEP, WALL = 3e-4, 1e-4, 2.5
"""Room that a part has beside walls, m, the step in which they are looked for, m, and how steep, m/m, a wall is."""
STICKY, STRETCH = 0.5e-3, 50e-6
"""A part that sticks comes loose this far, m, from its surface; from the second on it holds with its whole force."""
SETTLING, TIPS = 20, 5e-3
"""Steps in which a part settles, and how far it tilts in one, rad: the ground below it is another one then."""
_LEAN = 0.015
"""How much higher than drawn, m, a point of a leaning table's surface may be."""
_TAKEN = 5.0
"""How far aside, m, a person puts a part that is taken away."""
_BESIDE, _FLOOR = 1.5 * drawing.TABLE_HALF, 0.1
"""Farther than that, m, from the table's middle the floor is the ground, and what is higher, m, is above it."""


@dataclass(frozen=True, eq=False)
class Nest:
    """A nest on the vehicle, which fits the part as the surface does: `base_from_surface` (4, 4) is where that would
    be, and `world_from_base` tells where the vehicle has the arm's base. At first the part `lies` on the surface, or so
    in the nest, where that is `filled`."""

    base_from_surface: Pose
    world_from_base: Callable[[], Pose]
    lies: Pose
    filled: bool = False


class PartContact:
    """Where the part is and what forces act on it; safe between threads. At the start the claw holds the part at
    `flange_from_part`. The table reaches 0.25 m around the surface's origin."""

    def __init__(
        self, surface: Surface, world_from_surface: Pose, flange_from_part: Pose, *,
        world_from_table: Pose | None = None, surface_from_part: Pose | None = None,
        table_height: float = drawing.TABLE_HEIGHT, part: Surface | None = None, nest: Nest | None = None,
    ) -> None:  # fmt: skip
        """The table lies at the surface's origin, and the part's frame is the surface's when it is placed, unless
        `world_from_table` and `surface_from_part` say so. `part` is the underside of a part that does not fit the
        surface exactly, part frame, turned over. With a `nest` the part lies on the surface, and the claw is open.
        Raises ValueError when there is no surface for the part."""
        self._surface = surface
        self._surface_from_world = inverse(world_from_surface)
        self._world_from_surface = world_from_surface
        self._table_from_world = self._surface_from_world if world_from_table is None else inverse(world_from_table)
        self._table_height = table_height
        self._flange_from_part = flange_from_part
        fingers = flange_from_part[:3, :3] @ [0.0, 0.0, 1.0] * FINGERS_ABOVE + flange_from_part[:3, 3]
        self._fingertips = np.array([[x, y, 0.0] for x in (-0.02, 0.02) for y in (-0.01, 0.01)]) + fingers
        self._world_from_part: Pose | None = None
        self._claw_closed = True
        self.opening = np.eye(4)
        """How the part moves, in its own frame, as the claw opens, part before from part after; (4, 4)."""
        self.sticks = 0.0
        """With how much force, N, the surface holds a part that lies on it, until it is `STICKY` m away."""
        self._lock = threading.Lock()
        self._own = part is not None
        self._nest = nest
        self._base_from_part: Pose | None = None
        self._lying = False
        surface_from_part = np.eye(4) if surface_from_part is None else surface_from_part
        if part is None:
            x, y = _grid(surface)
            underside = np.stack([x, y, surface.height(x, y)], axis=-1)
        else:
            x, y = _grid(part)
            underside = moved_by(np.stack([x, y, -part.relief(x, y)[0]], axis=-1), surface_from_part)
            underside = underside[np.isfinite(underside).all(axis=1)]
            x, y = underside[:, 0], underside[:, 1]
        inside = (np.abs(x - surface.centre[0]) <= surface.half_x) & (np.abs(y - surface.centre[1]) <= surface.half_y)
        there = inside & np.isfinite(surface.relief(x, y)[0]) & ~_beside_wall(surface, x, y)
        if there.sum() < LEAST_TOUCHING:
            raise ValueError(
                f"the surface {surface.name!r} lies below {there.sum()} of {len(there)} points of the part's underside "
                f"(allowed: at least {LEAST_TOUCHING}); give a mesh that is seen from above, z up"
            )
        self._underside = moved_by(underside[there], inverse(surface_from_part))
        box = [[sx * surface.half_x, sy * surface.half_y, surface.top] for sx in (-1, 1) for sy in (-1, 1)]
        corners = moved_by(np.array(box) + np.array([*surface.centre, 0.0]), world_from_surface)
        self._highest = max(float(corners[:, 2].max()), float(world_from_surface[2, 3])) + _LEAN
        self._held_box = self._box(held=True)
        self._empty_box = self._box(held=False)
        self._table_at = inverse(self._table_from_world)[:2, 3].tolist()
        if nest is not None:
            self._claw_closed, self._lying = False, True
            below = nest.world_from_base() @ nest.base_from_surface if nest.filled else world_from_surface
            self._let_go(below @ nest.lies)

    @property
    def held(self) -> bool:
        """Whether the claw holds the part; the claw's grip feedback."""
        return self._world_from_part is None

    @property
    def untouched(self) -> bool:
        """Whether the part is where it was at first: in the claw, on the surface, or in the nest."""
        return self.held if self._nest is None else self._lying

    def part_pose(self, world_from_flange: Pose) -> Pose:
        """World_from_part (4, 4) when the flange is at `world_from_flange`."""
        with self._lock:
            return self._pose(world_from_flange)

    def _pose(self, world_from_flange: Pose) -> Pose:
        if self._world_from_part is None:
            return world_from_flange @ self._flange_from_part
        if self._base_from_part is not None and self._nest is not None:
            return self._nest.world_from_base() @ self._base_from_part
        return self._world_from_part.copy()

    def set_claw(self, closed: bool, world_from_flange: Pose) -> None:
        """Follow the claw's output: opening releases the part, closing within reach of it grips it."""
        with self._lock:
            if closed == self._claw_closed:
                return
            self._claw_closed = closed
            if closed:
                self._grip(world_from_flange)
            elif self._world_from_part is None:
                self._let_go(self._pose(world_from_flange) @ self.opening)

    def slide(self, world_from_surface: Pose) -> None:
        """From now on the surface lies there, and what lies on it has gone along; its table stays."""
        with self._lock:
            if self._world_from_part is not None and self._base_from_part is None:
                self._world_from_part = world_from_surface @ self._surface_from_world @ self._world_from_part
            self._world_from_surface = world_from_surface
            self._surface_from_world = inverse(world_from_surface)

    def take_away(self) -> None:
        """A person takes the part, from the claw or from where it lies, and puts it down far away."""
        with self._lock:
            self._world_from_part = self._world_from_surface @ drawing.pose((_TAKEN, 0.0, 0.0), (1, 0, 0), (0, 1, 0))
            self._base_from_part, self._lying = None, False

    def _let_go(self, world_from_part: Pose) -> None:
        """The part comes to rest where it is let go: in the nest, with which it rides, where that is below it."""
        if (nested := self._in_nest(world_from_part)) is None or self._nest is None:
            self._world_from_part = (self._settle if self._own else self._rest)(world_from_part)
            return
        # The nest has the surface's shape: where that is below the nest, the part rests in it as on the surface.
        rest = (self._settle if self._own else self._rest)(nested @ world_from_part)
        self._world_from_part = inverse(nested) @ rest
        self._base_from_part = inverse(self._nest.world_from_base()) @ self._world_from_part

    def _in_nest(self, at: Pose) -> Pose | None:
        """What brings the nest to the surface, world from world, where `at` is nearer to the nest; else None."""
        if self._nest is None:
            return None
        world_from_nest = self._nest.world_from_base() @ self._nest.base_from_surface
        apart = [math.dist(at[:2, 3], pose[:2, 3]) for pose in (world_from_nest, self._world_from_surface)]
        return self._world_from_surface @ inverse(world_from_nest) if apart[0] < apart[1] else None

    def _grip(self, world_from_flange: Pose) -> None:
        if self._world_from_part is None:
            return
        found = inverse(world_from_flange) @ self._pose(world_from_flange)
        turned = found[:3, :3].T @ self._flange_from_part[:3, :3]
        aside = np.linalg.norm(found[:3, 3] - self._flange_from_part[:3, 3])
        if aside <= GRIP_REACH and np.trace(turned) >= 1.0 + 2.0 * math.cos(GRIP_TURN):
            self._flange_from_part, self._lying = found, False
            self._world_from_part = self._base_from_part = None
            self._held_box = self._box(held=True)

    def _rest(self, world_from_part: Pose) -> Pose:
        """The part after it fell straight down (or sprang back up) to its first contact, its orientation kept."""
        rest = world_from_part.copy()
        for _ in range(20):
            depth, _ = self._below(moved_by(self._underside, rest))
            # Depth counts along z_S, the fall is along world z: repeated, because the table may lean a little.
            step = float(depth.max())
            rest[2, 3] += step
            if abs(step) < 1e-8:
                break
        return rest

    def _settle(self, world_from_part: Pose) -> Pose:
        """The part as it comes to rest under its weight: as low as it gets, turned about its middle, in no contact.

        Each step is a linear program: how far to come down and to tilt so that no point of the underside is below the
        ground, with the ground as it is below the part now.
        """
        rest = self._rest(world_from_part)
        for _ in range(SETTLING):
            points = moved_by(self._underside, rest)
            depth, _ = self._below(points)
            middle = points.mean(axis=0)
            x, y, _ = (points - middle).T
            over = -np.stack([np.ones(len(x)), y, -x], axis=1)
            room = [(-np.inf, np.inf), (-TIPS, TIPS), (-TIPS, TIPS)]
            made = scipy.optimize.linprog([1.0, 0.0, 0.0], over, -depth, bounds=room)
            if not made.success:
                break
            down, about_x, about_y = (float(v) for v in np.asarray(made.x))
            turn = rotation(np.array([about_x, about_y, 0.0]))
            rest[:3, :3] = turn @ rest[:3, :3]
            rest[:3, 3] = turn @ (rest[:3, 3] - middle) + middle + [0.0, 0.0, down]
            if abs(down) + abs(about_x) + abs(about_y) < 1e-7:
                break
        return self._rest(rest)

    def _box(self, held: bool) -> tuple[list[float], list[float]]:
        """Lowest and highest corner of what may touch the ground, in the flange: fingertips, and the part when held."""
        part = [moved_by(self._underside, self._flange_from_part)] if held else []
        points = np.concatenate([self._fingertips, *part])
        return points.min(axis=0).tolist(), points.max(axis=0).tolist()

    def _below(self, points: Vector) -> tuple[Vector, Vector]:
        """Depth (n,), m, of world `points` (n, 3) below the ground along z_S, and the ground's normals (n, 3) in S."""
        depth, normals, _ = self._under(points)
        return depth, normals

    def _under(self, points: Vector) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        """As `_below`, and where (n,) the ground is the table."""
        local, on_table = moved_by(points, self._surface_from_world), self._on_table(points)
        height, normals = self._surface.sample(local[:, 0], local[:, 1])
        return np.where(on_table, height, -self._table_height) - local[:, 2], normals, on_table

    def _on_table(self, points: Vector) -> NDArray[np.bool_]:
        made: NDArray[np.bool_] = (
            np.abs(moved_by(points, self._table_from_world)[:, :2]).max(axis=1) <= drawing.TABLE_HALF
        )
        return made

    def clear(self, points: Vector, radius: Vector) -> bool:
        """Whether world `points` (n, 3) with a `radius` (n,), m, are all above whatever the ground has."""
        return bool((points[:, 2] - radius).min() > self._highest)

    def below(self, points: Vector) -> tuple[Vector, NDArray[np.bool_]]:
        """How deep (n,), m, world `points` (n, 3) are below the ground, and where that is the table."""
        depth, _, on_table = self._under(points)
        return depth, on_table

    def wrench(self, world_from_flange: Pose) -> Vector:
        """Force (N) and torque about the flange's origin (Nm), (6,), on the flange, in world axes."""
        if (nested := self._in_nest(world_from_flange)) is not None:
            felt = self._pushed(nested @ world_from_flange)
            return np.concatenate([nested[:3, :3].T @ felt[:3], nested[:3, :3].T @ felt[3:]])
        return self._pushed(world_from_flange)

    def _pushed(self, world_from_flange: Pose) -> Vector:
        wrench = np.zeros(6)
        with self._lock:
            low, high = self._held_box if self._world_from_part is None else self._empty_box
            (*_, x), (*_, y), (*along, height), _ = world_from_flange.tolist()
            # The lowest corner of the box around the points: most of the time the arm is far from everything.
            lowest = height + sum(min(k * a, k * b) for k, a, b in zip(along, low, high, strict=True))
            beside = math.hypot(x - self._table_at[0], y - self._table_at[1]) > _BESIDE + math.hypot(
                *(max(-a, b) for a, b in zip(low, high, strict=True))
            )
            if lowest > self._highest or (beside and lowest > _FLOOR):
                return wrench
            points = moved_by(self._fingertips, world_from_flange)
            if self._world_from_part is None:
                points = np.concatenate([points, moved_by(self._underside, world_from_flange @ self._flange_from_part)])
        depth, normals = self._below(points)
        if self.sticks and self.held and -STICKY < (deepest := float(depth.max())) <= 0.0:
            wrench[2] = -self.sticks * min(1.0, -deepest / STRETCH)
            wrench[3:] = np.cross(points.mean(axis=0) - world_from_flange[:3, 3], wrench[:3])
        if depth.max() <= 0.0:
            return wrench
        # The part of a vertical depth along the normal; the whole underside has STIFFNESS along z.
        push = STIFFNESS / len(self._underside) * np.maximum(depth, 0.0) * normals[:, 2]
        forces = (push[:, None] * normals) @ self._world_from_surface[:3, :3].T
        wrench[:3] = forces.sum(axis=0)
        wrench[3:] = np.cross(points - world_from_flange[:3, 3], forces).sum(axis=0)
        return wrench


def _grid(field: Surface) -> tuple[Vector, Vector]:
    """x and y (n,) at which an underside is tried over the footprint of `field`."""
    # A margin keeps the points off the border, where the height field falls to the table.
    along = np.linspace(-0.98, 0.98, 25) * field.half_x + field.centre[0]
    across = np.linspace(-0.97, 0.97, 13) * field.half_y + field.centre[1]
    x, y = np.meshgrid(along, across)
    return x.ravel(), y.ravel()


def _beside_wall(surface: Surface, x: Vector, y: Vector) -> NDArray[np.bool_]:
    """Where (n,) a wall is nearer than `CLEARANCE`: there a part is made with room around it, else it would jam."""
    found = np.zeros(len(x), dtype=np.bool_)
    for ways in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        steps = CLEARANCE_STEP * np.arange(round(CLEARANCE / CLEARANCE_STEP) + 1)
        heights = surface.relief(x[:, None] + ways[0] * steps, y[:, None] + ways[1] * steps)[0]
        # Beside the surface there is no height, and a comparison with none is false.
        found |= (np.abs(np.diff(heights, axis=1)) > WALL * CLEARANCE_STEP).any(axis=1)
    return found


def moved_by(points: Vector, a_from_b: Pose) -> Vector:
    """Points (n, 3) of frame b in frame a."""
    moved: Vector = points @ a_from_b[:3, :3].T + a_from_b[:3, 3]
    return moved
