"""Opening a cell, and the open cell as work sees it: its devices, its folders, its world, how work is recorded.

Devices are real or simulated, over wires or on the virtual clock, and a lock holds them.
"""

import timeit
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TypeVar

from cell.config.cell_config import CellConfig, Confirm, config_to_open, load_config, require_real_addresses
from cell.config.files import DEVICES, beside
from cell.config.job import Job
from cell.devices.assembly import connect, connected_for
from cell.devices.devices import Devices, require_healthy, require_no_emergency_stop
from cell.devices.lock import CellLock
from cell.devices.simulated.mixed import Sim, simulated_of
from cell.devices.simulated.process import SimulatedCell, Simulation, ask_truth, on_gige, with_endpoints
from cell.procedures.arm.moves import Mover, Pace
from cell.procedures.drive.way import Whereabouts
from cell.run.recorded_work import RecordedWork, WorkContext
from cell.run.runs import Run
from drivers.errors import ConfigError, NotConnectedError

Made = TypeVar("Made")


@dataclass(frozen=True, eq=False)
class OpenCell:
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
            self.devices.arm, self.devices.clock, self.config, job=job, hold=hold, interlocks=self.devices.interlocks,
            pace=self.pace,
        )  # fmt: skip

    @property
    def world(self) -> dict[str, object]:
        """Whether this cell is simulated, and which world; its pace; and the interlocks that do not hold, if any."""
        facts: dict[str, object] = {"simulated": False, "seed": None, "level": None, "clock": "wall"}
        if self.simulated is not None:
            facts = self.simulated.facts
        lifted = sorted(self.devices.interlocks.names_lifted)
        return {**facts, "pace": self.pace.share, **({"interlocks_lifted": lifted} if lifted else {})}

    @property
    def facts(self) -> dict[str, object]:
        """The cell's name and its world, for the record of work outside a job."""
        return {"cell": self.config.cell.name, **self.world}

    @property
    def truth(self) -> Callable[[], dict[str, object]] | None:
        """How the report asks a simulated world for its truth; None where there is none."""
        # Beside a real scan camera the simulated world has nothing to do with where the part comes to lie.
        if self.simulated is not None and "scan_camera" in self.simulated.simulated:
            return self.simulated.truth
        # What a claw holds that is not told to open stays there.
        if self.simulated is not None and "claw" in self.simulated.simulated:
            return None
        return partial(ask_truth, self.config.cell.truth) if self.config.cell.truth else None

    def recorded(
        self, run: Run[object], kind: str, work: Callable[[WorkContext], Made], info: Mapping[str, object] | None = None
    ) -> Made:
        """Do work outside a job in a run that was begun, and record it; raises what `RecordedWork.perform` does."""
        # Who puts a part into the claw opens the cell's guard, and takes as long as it takes.
        health = require_no_emergency_stop if kind in ("jog", "recovery", "loading") else require_healthy
        facts, told = {**self.facts, **(info or {})}, None if kind == "loading" else self.config
        recorded = RecordedWork(run, kind, self.devices, self.runs_folder, facts, health=health, config=told)
        return recorded.perform(work)


SIM_SPEED, ADDED_S = 3.0, 4.5e-3
"""So many times faster than the wall runs a simulated cell over wires, if 100,000 additions take at most so long, s."""


def kept_speed(added_s: float) -> float:
    """The pace of a simulated cell on a computer that takes `added_s` for those additions: a slow one would miss the
    devices' deadlines, which are on the wall."""
    return max(1.0, min(SIM_SPEED, SIM_SPEED * ADDED_S / added_s // 0.25 * 0.25))


@dataclass(frozen=True, kw_only=True)
class SessionRequest:
    """Which cell is to be opened, and how: the arguments of `Cell.open`, which tells them."""

    config: str | Path | None
    sim: Sim
    seed: int
    level: str
    speed: float | None
    job: str | Path
    confirm: Confirm | None
    only: Collection[str]
    clock: str
    truth: str | Path | None

    def open(self, undo: ExitStack) -> OpenCell:
        """Connect as `Cell.open` says, and raise what it says. What is to be undone if that fails goes to `undo`."""
        given = None if self.config is None else Path(self.config)
        names = simulated_of(self.sim, given)
        whole = set(names) == set(DEVICES)
        self._require_sense(whole)
        path, loaded = config_to_open(given, simulated=whole, confirm=self.confirm)
        # So that whatever keeps the configuration keeps what was simulated.
        loaded = loaded.model_copy(update={"cell": loaded.cell.model_copy(update={"sim": names})})
        folder = beside(path)
        true = loaded if self.truth is None else load_config(Path(self.truth))
        if self.clock == "virtual":
            return self._virtual(loaded, true, folder)
        needed = connected_for(loaded, self.only)
        for name in needed:
            if missing := (whole or name not in names) and loaded.make(name).missing():
                raise NotConnectedError(name, missing)
        world: SimulatedCell | None = None
        if whole:
            world = self._world(loaded, true)
            undo.callback(world.close)
            loaded = with_endpoints(loaded, world.endpoints)
        else:
            require_real_addresses(loaded, names)
        if beside_real := tuple(name for name in names if name in needed and not whole):
            return self._mixed(undo, loaded, folder, beside_real, needed)
        lock = undo.enter_context(CellLock(loaded, needed))
        devices = connect(loaded, needed)
        undo.callback(devices.close)
        return OpenCell(loaded, folder, lock, devices, world)

    def _require_sense(self, whole: bool) -> None:
        """Raise `ConfigError` for arguments that do not go together; `whole` for a cell that is all simulated."""
        if self.clock not in ("wall", "virtual"):
            raise ConfigError(
                f'clock="{self.clock}" is not offered: "wall" keeps time with the wall, "virtual" does not wait'
            )
        if self.clock == "virtual" and (not whole or self.speed is not None):
            wrong = "speed means nothing on it" if whole else 'only a simulated cell, sim="all", has one'
            raise ConfigError(f'clock="virtual": {wrong}; leave that out')
        if self.truth is not None and not whole:
            raise ConfigError("truth describes a cell that is all simulated; leave it out where devices are real")

    # The world takes long to load, and real devices have none; over wires it is in another process.

    def _virtual(self, loaded: CellConfig, true: CellConfig, folder: Path) -> OpenCell:
        from cell.devices.simulated.described import Described
        from cell.devices.simulated.direct import VirtualCell

        virtual = VirtualCell(loaded, self.seed, self.level, Described.of(self.job), true)
        return OpenCell(loaded, folder, nullcontext(), virtual.devices, virtual)

    def _world(self, loaded: CellConfig, true: CellConfig) -> SimulatedCell:
        from cell.devices.simulated.described import Described
        from cell.measure.vision.stripe.extract import read_drawn

        added = 0.1 * timeit.timeit("for i in range(100_000): s += i", "s = 0", number=10)
        return SimulatedCell(
            true, Described.of(self.job), seed=self.seed, level=self.level, speed=self.speed or kept_speed(added),
            gige=on_gige(loaded), meanwhile=read_drawn if set(self.only) == set(DEVICES) else None,
        )  # fmt: skip

    def _mixed(
        self, undo: ExitStack, loaded: CellConfig, folder: Path, simulated: tuple[str, ...], needed: list[str]
    ) -> OpenCell:
        from cell.devices.simulated.mixed import MixedCell

        if self.speed not in (None, loaded.cell.time_scale):
            raise ConfigError(f"speed={self.speed:g}: real devices keep the wall's time; leave that out")
        mixed = MixedCell(undo, loaded, self.job, seed=self.seed, level=self.level, simulated=simulated, needed=needed)
        return OpenCell(mixed.config, folder, mixed.lock, mixed.devices, mixed.world)
