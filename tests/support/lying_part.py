"""A part that lies somewhere on its surface, in a cell that stands before it: what `verify` makes of it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin

from cell.config.job import FeatureSection, load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_matrix, from_parts
from cell.measure.inversion import NominalSurface
from cell.procedures.arm.moves import PartState
from cell.procedures.grasp import GraspSeries
from cell.procedures.placed_part import PlacedPart
from cell.procedures.steps.workplace import PartsBefore
from lab.bench.job.part_jobs import MIDDLE, job_with_part
from lab.bench.job.whole_job import JobRecord
from sim_backends.world.drawing import inverse
from tests.support.at_station import AtStation
from tests.support.report_runs import changed


@dataclass(eq=False)
class LyingPart:
    """A cell of `record` at its station, whose part was put down; `also` is of the job's [place].

    It is swept `faster` than shipped. `changed` changes its world before anybody looks, `heard` is called with each
    text that is told, `series` tells of parts before, and the job names these
    `features`. `notes` are the texts, `parts` what it noted of the part, and
    `carried` whether its moves reckoned with a part in the claw then.
    """

    record: JobRecord
    folder: Path
    half: tuple[float, float] = MIDDLE
    verify: str = "all"
    flat: bool = False
    also: str = "corrections = 0"
    faster: float = 2.6
    changed: Callable[[VirtualCell], None] = lambda cell: None
    heard: Callable[[VirtualCell, str], None] = lambda cell, text: None
    series: GraspSeries = field(default_factory=GraspSeries)
    features: tuple[FeatureSection, ...] = ()
    _site: AtStation = field(init=False)
    notes: list[str] = field(default_factory=list, init=False)
    parts: list[str] = field(default_factory=list, init=False)
    carried: list[bool] = field(default_factory=list, init=False)

    def looked(self, off: pin.SE3) -> PlacedPart:
        """What the step makes of a part that lies `off` its place."""
        file = job_with_part(self.folder, "pot", verify=self.verify, half=self.half, flat=self.flat, also=self.also)
        job, mesh = load_job(file)
        quick = changed(job, "scan", speed=self.faster * job.scan.speed)
        quick = changed(quick, "part", feature=self.features) if self.features else quick
        nominal = NominalSurface.load(mesh, unit=job.surface.mesh_unit)
        self._site = site = AtStation(
            self.record, self.folder, quick, nominal, folded=False, changed=self.changed,
            notify=lambda event: self._told(event.data),
        )  # fmt: skip
        cell, work = site.cell, site.work
        cell.devices.claw.bare.release()
        scene, now = cell.world.scene, cell.clock.now()
        cell.world.part._world_from_part = scene.world_from_surface @ off.homogeneous
        work.parts_before = PartsBefore(self.series)
        work.part.state = PartState.RELEASED
        work.part.where = from_matrix(inverse(cell.world.world_from_base(now)) @ scene.world_from_surface) * off
        work.mover.leave_part(work.part.where)
        found = site.do("verify")
        assert isinstance(found, PlacedPart)
        return found

    @property
    def cell(self) -> VirtualCell:
        """The one that looked last."""
        return self._site.cell

    def _told(self, data: dict[str, object]) -> None:
        if "part" in data:
            self.parts.append(str(data["part"]))
            self.carried.append(any(body.name == "part" for body in self._site.work.mover.solids()))
        if "text" in data:
            self.notes.append(str(data["text"]))
            self.heard(self.cell, self.notes[-1])

    def stands(self) -> set[str]:
        """What stands about, as the interlocks know it."""
        return {body.name for body in self.cell.devices.interlocks.situation.station}

    def lies(self) -> pin.SE3:
        """surface_from_part, as it is in the world."""
        scene, world = self.cell.world.scene, self.cell.world
        flange = world.world_from_base(self.cell.clock.now()) @ world.arm.base_from_flange(self.cell.clock.now())
        return from_matrix(inverse(scene.world_from_surface) @ world.part.part_pose(flange))


Lying = Callable[..., LyingPart]
"""Gives a part that lies in the cell of `placed_pot`, as `LyingPart` has it."""


def moved(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> pin.SE3:
    """A motion by these, m and rad."""
    return from_parts((x, y, z), pin.exp3(np.array(turn)))


def creeps(cell: VirtualCell, rate: pin.SE3, until: float = 1e9) -> None:
    """Each second the part moves on by `rate`, part frame, for so many seconds of its sweep."""
    part, stands, began = cell.world.part, cell.world.part._pose, list[float]()

    def pose(flange: np.ndarray) -> np.ndarray:
        if not began and cell.devices.laser.is_on:
            began.append(cell.clock.now())
        since = min(until, cell.clock.now() - began[0]) if began else 0.0
        return stands(flange) @ pin.exp6(since * pin.log6(rate).vector).homogeneous

    part._pose = pose
