"""The station of one scene as bodies: the surface as it is felt and as it is seen, and how far it reaches."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.mesh import Mesh
from sim_backends.world.bodies import surfaces
from sim_backends.world.bodies.surfaces import OwnSurface, Surface, SurfaceMesh, own_surface, part_mesh, underside
from sim_backends.world.bodies.surfaces import mesh as drawn_mesh
from sim_backends.world.bodies.surfaces import surface as named_surface
from sim_backends.world.drawing import StationDrawing, inverse

_KEPT = 4
"""Meshes with their box trees, which take longer to make than all the rest of a world."""


@dataclass(frozen=True, eq=False)
class Station:
    """`ground` is what a part meets, `seen` what cameras see, both in S; a ball about S of `radius`, m, holds it.

    `part` is the underside of the part, part frame, turned over; None for one that fits the ground exactly. `part_seen`
    is all of it as the scan camera sees it, part frame; None for one that no camera sees.
    """

    ground: Surface
    seen: Mesh
    radius: float
    part: Surface | None
    part_seen: Mesh | None = None

    @classmethod
    def of(cls, drawn: StationDrawing) -> Self:
        """The station as drawn. Raises ValueError for an unknown surface or a file that is no mesh."""
        if not drawn.mesh:
            ground, seen = named_surface(drawn.surface), _closed_form(drawn.surface, drawn.waviness)
        else:
            table = _plane(inverse(drawn.place_from_surface))
            own = own_surface(drawn.mesh, drawn.mesh_unit)
            ground, seen = replace(own.ground, table=table), _own(own, table, drawn.waviness)
        if drawn.waviness[0]:
            ground = surfaces.waved(ground, drawn.waviness)
        (x, y), low = ground.centre, min(0.0, float(seen.low[0, 2]))
        reach = np.hypot(abs(x) + ground.half_x, abs(y) + ground.half_y)
        room = max(0.015, ground.top, -low)
        part = underside(drawn.part_mesh, drawn.part_mesh_unit) if drawn.part_mesh else None
        whole = _whole(part_mesh(drawn.part_mesh, drawn.part_mesh_unit)) if drawn.part_mesh else None
        return cls(ground, seen, float(reach) + room, part, whole)


def _plane(surface_from_place: NDArray[np.float64]) -> tuple[float, float, float]:
    """The table z = a + b x + c y in S."""
    normal, point = surface_from_place[:3, 2], surface_from_place[:3, 3]
    return float(normal @ point / normal[2]), float(-normal[0] / normal[2]), float(-normal[1] / normal[2])


@lru_cache(maxsize=_KEPT)
def _closed_form(name: str, waviness: tuple[float, float, float]) -> Mesh:
    return _waved(drawn_mesh(name), waviness)


@lru_cache(maxsize=_KEPT)
def _own(own: OwnSurface, table: tuple[float, float, float], waviness: tuple[float, float, float]) -> Mesh:
    return _waved(own.walled(table), waviness)


def _waved(made: SurfaceMesh, waviness: tuple[float, float, float]) -> Mesh:
    """As seen, with its waviness; the feet of the sides move with it, below what is looked at."""
    vertices = made.vertices.copy()
    vertices[:, 2] += surfaces.wave(vertices[:, 0], vertices[:, 1], waviness)[0]
    return Mesh(vertices, made.triangles)


@lru_cache(maxsize=_KEPT)
def _whole(part: SurfaceMesh) -> Mesh:
    return Mesh(part.vertices, part.triangles)
