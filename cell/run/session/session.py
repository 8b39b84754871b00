"""An open cell as the work on it sees it: its devices, where results go, what world it stands in, how work is recorded.

What goes on in it, one run at a time, is `cell.run.runs`'s; how it is opened, `cell.run.session.opening`'s.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.devices.devices import Devices
from cell.devices.simulated.process import Simulation
from cell.devices.simulated.truth_link import ask_truth
from cell.devices.stopping import require_healthy, require_no_emergency_stop
from cell.procedures.arm.moves import Mover
from cell.procedures.drive.whereabouts import Whereabouts
from cell.procedures.pace import Pace
from cell.run.recorded_work import Hands, RecordedWork
from cell.run.run import Run

Made = TypeVar("Made")


@dataclass(frozen=True, eq=False)
class Opened:
    """What a cell consists of; `lock` is held, `simulated` is None unless this process has started the world."""

    config: CellConfig
    folder: Path
    lock: AbstractContextManager[object]
    devices: Devices
    simulated: Simulation | None

    @cached_property
    def whereabouts(self) -> Whereabouts:
        """What is known of where the vehicle stands."""
        return Whereabouts(self.devices.vehicle)

    @cached_property
    def pace(self) -> Pace:
        """How fast work moves arm and vehicle, of what is planned."""
        return Pace()

    @property
    def runs_folder(self) -> Path:
        """Where run folders go."""
        return self.folder / self.config.cell.runs

    @property
    def calibrations_folder(self) -> Path:
        """Where calibrations are stored."""
        return self.folder / self.config.cell.calibrations

    def mover(self, job: Job | None, hold: Callable[[], None] = lambda: None) -> Mover:
        """Planned moves of the arm; with a job, its part is in the claw. `hold` is called before each free motion."""
        return Mover(
            self.devices.arm,
            self.devices.clock,
            self.config,
            job=job,
            hold=hold,
            interlocks=self.devices.interlocks,
            pace=self.pace,
        )

    @property
    def world(self) -> dict[str, Any]:
        """Whether this cell is simulated, and which world; and the interlocks that do not hold, if any."""
        facts: dict[str, Any] = {"simulated": False, "seed": None, "level": None, "clock": "wall"}
        if self.simulated is not None:
            facts = self.simulated.facts
        lifted = sorted(self.devices.interlocks.names_lifted)
        return {**facts, "interlocks_lifted": lifted} if lifted else facts

    @property
    def facts(self) -> dict[str, Any]:
        """The cell's name and its world, for the record of work outside a job."""
        return {"cell": self.config.cell.name, **self.world}

    @property
    def truth(self) -> Callable[[], dict[str, Any]] | None:
        """How the report asks a simulated world for its truth; None where there is none."""
        # Beside a real scan camera the simulated world has nothing to do with where the part comes to lie.
        if self.simulated is not None and "scan_camera" in self.simulated.simulated:
            return self.simulated.truth
        # What a claw holds that is not told to open stays there.
        if self.simulated is not None and "claw" in self.simulated.simulated:
            return None
        return partial(ask_truth, self.config.cell.truth) if self.config.cell.truth else None

    def recorded(
        self, run: Run[Any], kind: str, work: Callable[[Hands], Made], info: dict[str, Any] | None = None
    ) -> Made:
        """Do work outside a job in a run that was begun, and record it; raises what `RecordedWork.perform` does."""
        health = require_no_emergency_stop if kind in ("jog", "recovery") else require_healthy
        facts = {**self.facts, **(info or {})}
        recorded = RecordedWork(run, kind, self.devices, self.runs_folder, facts, health=health, config=self.config)
        return recorded.perform(work)
