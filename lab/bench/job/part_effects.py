"""What may come between a surface and the part on it, and show to nobody before the part was placed."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.config.job import Job
from cell.measure.inversion.nominal import read_mesh
from lab.bench.job.part_jobs import Floats, body, within
from sim_backends.world.bodies.station import Station
from sim_backends.world.scene import Scene, rotation
from sim_backends.world.world import World

Change = Callable[[World], None]


@dataclass(frozen=True)
class PartEffect:
    """One effect: what has happened, as keys of `cell.procedures.steps.verify.LIKELY` of which one is to be told, and
    how a world gets it: a `change` of it, or another `underside` or `upper` side of its part, corners (n, 3), m.

    Without `causes` the part comes to lie where it belongs, or nearly.
    """

    causes: tuple[str, ...]
    change: Change | None = None
    underside: Callable[[Floats], Floats] | None = None
    upper: Callable[[Floats], Floats] | None = None

    def put_into(self, world: World, job: Job, mesh: Path, half: tuple[float, float], folder: Path) -> None:
        """Give it to the world of a job, whose part covers `half` of its surface; files go to `folder`."""
        if self.change is not None:
            self.change(world)
        if self.underside is not None or self.upper is not None:
            file = folder / "made.ply"
            made = body(*within(*read_mesh(mesh, job.surface.mesh_unit), half), self.underside or np.copy)
            if self.upper is not None:
                # The corners above stand behind those below.
                above = len(made.vertices) // 2
                made.vertices[above:] = self.upper(made.vertices[above:])
            made.export(file)
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
    return lambda world: world.remake(
        replace(world.scene, flange_from_part=world.scene.flange_from_part @ by), world.station
    )


def opened(by: Floats) -> Change:
    """The part moves as the claw opens, each time."""

    def change(world: World) -> None:
        world.part.opening = by

    return change


def as_it_opens(what: Change) -> Change:
    """It happens as soon as the claw has let the part go, each time."""

    def change(world: World) -> None:
        part, set_claw = world.part, world.part.set_claw

        def then(closed: bool, world_from_flange: Floats) -> None:
            held = part.held
            set_claw(closed, world_from_flange)
            if held and not part.held:
                what(world)

        part.set_claw = then  # type: ignore[method-assign]

    return change


def scene(made: Callable[[Scene], Scene]) -> Change:
    """From then on cameras see another scene; where the part is does not change."""

    def change(world: World) -> None:
        now = world._items[world._current]
        world._items[world._current] = replace(now, scene=made(now.scene))
        world._make_current(world.collisions.found)

    return change


def laser_turned(angle: float) -> Change:
    """The light plane has turned about the laser's exit and the stripe, mrad."""

    def turned(drawn: Scene) -> Scene:
        normal = rotation(1e-3 * np.array([0.0, angle, 0.0])) @ drawn.light_plane_normal
        return replace(drawn, light_plane_normal=normal, light_plane_distance=float(normal @ drawn.laser_origin))

    return scene(turned)


def head_slipped(by: Floats) -> Change:
    """The scan head sits elsewhere on its mount."""
    return scene(lambda drawn: replace(drawn, flange_from_scan_camera=drawn.flange_from_scan_camera @ by))


def screw_worn(world: World) -> None:
    """The rail's screw has .05 mm of play."""
    params = world.rail.params
    world.rail.params = replace(params, screw=replace(params.screw, backlash=0.05e-3))


def later(by: Floats, seconds: float) -> Change:
    """The part slips over the surface so long after it was let go, once, and settles there."""

    def change(world: World) -> None:
        part, stands, due = world.part, world.part._pose, [world.clock.now() + seconds]

        def pose(world_from_flange: Floats) -> Floats:
            if due and world.clock.now() >= due[0] and not part.held:
                due.clear()
                part._world_from_part = part._settle(stands(world_from_flange) @ by)
            return np.asarray(stands(world_from_flange))

        part._pose = pose  # type: ignore[method-assign]

    return as_it_opens(change)


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


def _bent(corners: Floats) -> Floats:
    return corners - np.outer((corners[:, 0] / 0.022) ** 2, [0.0, 0.0, 0.15e-3])


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
    "underside .4 mm low": PartEffect(ON_SOMETHING, underside=lambda v: np.add(v, [0.0, 0.0, -0.4e-3])),
    "underside .4 mm worn": PartEffect(("deep",), underside=lambda v: np.add(v, [0.0, 0.0, 0.4e-3])),
    "underside .3 mm worn on one half": PartEffect(("tilted",), underside=raised(lambda v: v[:, 0] > 0, 0.3)),
    "underside 5 mrad askew": PartEffect(("tilted",), underside=lambda v: v + np.outer(v[:, 0], [0.0, 0.0, 0.005])),
    "underside bulged by .3 mm": PartEffect(
        ON_SOMETHING, underside=lambda v: v - np.outer(np.exp(-((v[:, 0] / 0.008) ** 2)), [0.0, 0.0, 0.3e-3])
    ),
    "upper side .3 mm aside in x": PartEffect((), upper=lambda v: np.add(v, [0.3e-3, 0.0, 0.0])),
    "upper side .15 mm aside in y": PartEffect((), upper=lambda v: np.add(v, [0.0, 0.15e-3, 0.0])),
    "upper side .3 mm aside in y": PartEffect((), upper=lambda v: np.add(v, [0.0, 0.3e-3, 0.0])),
    "grown by 2 per mille": PartEffect((), underside=lambda v: 1.002 * v, upper=lambda v: 1.002 * v),
    "bent by .15 mm": PartEffect((), underside=_bent, upper=_bent),
    "slips .4 mm in y while it is swept": PartEffect(SLIPPED, later(motion(0.0, 0.4), 8.0)),
    "surface pushed .3 mm in x as the claw opens": PartEffect((), as_it_opens(lambda world: world.slide(motion(0.3)))),
    "laser turns 1 mrad as the claw opens": PartEffect((), as_it_opens(laser_turned(1.0))),
    "scan head slips .3 mm as the claw opens": PartEffect((), as_it_opens(head_slipped(motion(0.3)))),
    "joint 6 turns 2 mrad as the claw opens": PartEffect((), as_it_opens(lambda world: world.arm.shift_zero(5, 2e-3))),
    "rail's screw has play of .05 mm": PartEffect((), screw_worn),
}
