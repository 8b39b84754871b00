"""A cell that stands where a whole job placed: single steps are done there, without all that comes before them."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.config.calibrations.store import link_of
from cell.config.job import Job
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration.drift.timing import StampTiming
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.effects.between_sweeps import SurfaceMotion
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import PartState
from cell.procedures.sought_part import nominal_of, sought
from cell.procedures.steps.kinds import kind_of
from cell.procedures.sweep import second_look
from cell.procedures.sweep.second_look import require_surface_unmoved
from lab.bench.job.whole_job import JobRecord, NoFrames
from statemachine.control import RunControl
from statemachine.runner import Event, StepContext
from tests.support.report_runs import CONFIG, at_station, pot, work_of


@dataclass(eq=False, repr=False)
class AtStation:
    """A cell of `record` where that placed, `further` metres on, its vehicle braked; `made` is what `record` made.

    `job` and `nominal` are those of `pot()` if not told otherwise, the arm's joints those of the sweep if `folded`:
    with others its errors are others. `timed`: it is known how late the camera's stamps come. `changed` changes the
    cell before anything moves, `notify` hears what steps tell.
    """

    record: JobRecord
    folder: Path
    job: Job = field(default_factory=lambda: pot()[0])
    nominal: NominalSurface = field(default_factory=lambda: pot()[1])
    further: float = 0.0
    level: str = ""
    folded: bool = True
    timed: bool = False
    changed: Callable[[VirtualCell], None] = lambda cell: None
    notify: Callable[[Event], None] = lambda event: None
    check: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        assert self.nominal.source is not None
        described = Described(self.job, self.nominal.source)
        self.job, mesh = sought(self.job, self.nominal.source)
        self.nominal = self.nominal if mesh == self.nominal.source else nominal_of(self.job, mesh)
        self.cell = VirtualCell(CONFIG, self.record.seed, self.level or self.record.level, described)
        at_station(self.cell, self.record, self.further)
        self.cell.devices.vehicle.brake()
        self.changed(self.cell)
        self.kind, self.control = kind_of(self.job), RunControl()
        self.work = work_of(self.cell, self.job, self.nominal, self.record, NoFrames(), self.folder)
        self.work.part.state = PartState.first(self.job)
        if self.timed:
            scan = self.work.calibration.scan
            timing = StampTiming(0.0, 0.1e-3, 0.0, 2e-6, 0.0, 1e-5, 0.0, 1e9, link_of(CONFIG))
            self.work.calibration = replace(self.work.calibration, scan=replace(scan, timing=timing))
        self.made: dict[str, Any] = dict(self.record.results)
        if self.folded:
            self.cell.devices.interlocks.work_with(self.work.calibration.configuration)
            self.work.mover.to_joints(HOME)

    def context(self, name: str, attempt: int = 1) -> StepContext:
        """What this step of the job is given."""
        step = self.kind.policy().of(name)
        return StepContext(step, attempt, math.inf, self.made, self.cell.clock, self.notify, self.control, self.check)

    def do(self, *names: str) -> Any:
        """Do these steps; gives the last one's result, which all later ones get instead of the record's."""
        for name in names:
            self.made[name] = self.kind.work(self.work)[name](self.context(name))
        return self.made[names[-1]]

    @property
    def ended(self) -> JobRecord:
        """The record of what was done here instead, with the world's truth now."""
        return replace(self.record, results=self.made, rests=np.array(self.cell.arm.rests), at_end=self.cell.truth())


Station = Callable[..., AtStation]
"""Gives a cell that stands where `placed_pot` placed, as `AtStation` has it."""


def lose_few_steps_after_the_look(patch: pytest.MonkeyPatch, cell: Callable[[], VirtualCell]) -> None:
    """Have the cell's rail lose .09 mm where it stands after the second look, whose lines do not show as little."""

    def after_the_look(moved: SurfaceMotion) -> None:
        rail, now = cell().world.rail, cell().clock.now()
        rail.set_position(now, rail.position(now) + round(0.09e-3 * 200 * 256 / 0.002))
        require_surface_unmoved(moved)

    patch.setattr(second_look, "require_surface_unmoved", after_the_look)
