"""What may come between a surface and the part on it, and show to nobody before the part was placed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.config.job import Job
from cell.measure.inversion.nominal import read_mesh
from lab.bench.job.part_jobs import Floats, body, within
from sim_backends.world.bodies.station import Station
from sim_backends.world.scene import rotation
from sim_backends.world.world import World

Change = Callable[[World], None]


@dataclass(frozen=True)
class PartEffect:
    """One effect: what has happened, as keys of `cell.procedures.steps.verify.LIKELY` of which one is to be told, and
    how a world gets it: a `change` of it, or another `underside` of its part, corners (n, 3), m.

    Without `causes` the part comes to lie where it belongs, or nearly.
    """

    causes: tuple[str, ...]
    change: Change | None = None
    underside: Callable[[Floats], Floats] | None = None

    def put_into(self, world: World, job: Job, mesh: Path, half: tuple[float, float], folder: Path) -> None:
        """Give it to the world of a job, whose part covers `half` of its surface; files go to `folder`."""
        if self.change is not None:
            self.change(world)
        if self.underside is not None:
            file = folder / "made.ply"
            body(*within(*read_mesh(mesh, job.surface.mesh_unit), half), self.underside).export(file)
            drawn = replace(world.scene.drawing.station, part_mesh=str(file), part_mesh_unit="m")
            world.remake(world.scene, Station.of(drawn))


def motion(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: tuple[float, float, float] = (0, 0, 0)) -> Floats:
    """(4, 4) of a shift in mm and a turn in mrad."""
    made = np.eye(4)
    made[:3, :3] = rotation(1e-3 * np.array(turn, dtype=np.float64))
    made[:3, 3] = 1e-3 * np.array([x, y, z])
    return made


def held(by: Floats) -> Change:
    """The claw holds the part elsewhere than stated."""

    def change(world: World) -> None:
        world.remake(replace(world.scene, flange_from_part=world.scene.flange_from_part @ by), world.station)

    return change


def opened(by: Floats) -> Change:
    """The part moves as the claw opens, each time."""

    def change(world: World) -> None:
        world.part.opening = by

    return change


def under(x: float, y: float, height: float, radius: float = 1.5) -> Change:
    """Something lies on the surface that no camera sees, in mm."""

    def change(world: World) -> None:
        ground = world.station.ground
        bare = ground.relief

        def relief(a: Floats, b: Floats) -> tuple[Floats, Floats, Floats]:
            z, along, across = bare(a, b)
            on: NDArray[np.bool_] = (np.asarray(a) - 1e-3 * x) ** 2 + (np.asarray(b) - 1e-3 * y) ** 2 < 1e-6 * radius**2
            return np.where(on, z + 1e-3 * height, z), along, across

        world.remake(world.scene, replace(world.station, ground=replace(ground, relief=relief)))

    return change


def raised(where: Callable[[Floats], NDArray[np.bool_]], by: float) -> Callable[[Floats], Floats]:
    """An underside that is `by` mm higher than drawn at its corners `where`."""
    return lambda corners: corners + np.multiply.outer(where(corners), [0.0, 0.0, 1e-3 * by])


def _everywhere(corners: Floats) -> NDArray[np.bool_]:
    return np.ones(len(corners), dtype=np.bool_)


SLIPPED, ON_SOMETHING = ("shifted",), ("raised", "tilted")
EFFECTS: dict[str, PartEffect] = {
    "nothing": PartEffect(()),
    "held tilted, 5 mrad about y": PartEffect((), held(motion(turn=(0, 5, 0)))),
    "held tilted, 5 mrad about x": PartEffect((), held(motion(turn=(5, 0, 0)))),
    "held tilted, 4 mrad about both": PartEffect((), held(motion(turn=(4, -4, 0)))),
    "held aside, .5 mm in x": PartEffect(SLIPPED, held(motion(0.5))),
    "held aside, .5 mm in y": PartEffect(SLIPPED, held(motion(0.0, 0.5))),
    "held aside, 1 mm in y": PartEffect(SLIPPED, held(motion(0.0, 1.0))),
    "held turned, 8 mrad": PartEffect(SLIPPED, held(motion(turn=(0, 0, 8)))),
    "slips as the claw opens, .5 mm in x": PartEffect(SLIPPED, opened(motion(0.5))),
    "slips as the claw opens, .9 mm in y": PartEffect(SLIPPED, opened(motion(0.0, 0.9))),
    "turns as the claw opens, 6 mrad": PartEffect(SLIPPED, opened(motion(turn=(0, 0, 6)))),
    "tips as the claw opens, 5 mrad": PartEffect((), opened(motion(turn=(0, 5, 0)))),
    "on a chip of .5 mm at an edge": PartEffect(ON_SOMETHING, under(15, 8, 0.5)),
    "on a chip of .4 mm in the middle": PartEffect(ON_SOMETHING, under(2, 3, 0.4)),
    "on a chip of .3 mm at a corner": PartEffect(ON_SOMETHING, under(-18, -14, 0.3)),
    "on a hair of .25 mm": PartEffect(ON_SOMETHING, under(-5, 0, 0.25, 0.8)),
    "on a film of .4 mm": PartEffect(ON_SOMETHING, under(0, 0, 0.4, 60.0)),
    "underside .3 mm low on one half": PartEffect(ON_SOMETHING, underside=raised(lambda v: v[:, 0] > 0, -0.3)),
    "underside .3 mm low at a corner": PartEffect(
        ON_SOMETHING, underside=raised(lambda v: (v[:, 0] > 0.012) & (v[:, 1] > 0.008), -0.3)
    ),
    "underside .4 mm low": PartEffect(ON_SOMETHING, underside=raised(_everywhere, -0.4)),
    "underside .4 mm worn": PartEffect(("deep",), underside=raised(_everywhere, 0.4)),
    "underside .3 mm worn on one half": PartEffect(("tilted",), underside=raised(lambda v: v[:, 0] > 0, 0.3)),
    "underside 5 mrad askew": PartEffect(("tilted",), underside=lambda v: v + np.outer(v[:, 0], [0.0, 0.0, 0.005])),
    "underside bulged by .3 mm": PartEffect(
        ON_SOMETHING, underside=lambda v: v - np.outer(np.exp(-((v[:, 0] / 0.008) ** 2)), [0.0, 0.0, 0.3e-3])
    ),
}
"""By name."""
