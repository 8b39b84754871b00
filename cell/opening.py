"""Opening a cell: its devices, real or simulated, over wires or on the virtual clock, and the lock that holds them."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import ExitStack, nullcontext
from pathlib import Path

from cell.config import Confirm, beside, config_to_open, load_config
from cell.devices.assembly import connect, connected_for
from cell.devices.simulated import SimulatedCell, on_gige, with_endpoints
from cell.opened import Opened
from cell.run.lock import CellLock
from drivers.errors import ConfigError

SIM_SPEED = 3.0
"""How many times faster than the wall a simulated cell runs unless told otherwise."""


def open_devices(
    undo: ExitStack,
    config: str | Path | None,
    *,
    sim: str | None,
    seed: int,
    level: str,
    speed: float | None,
    job: str | Path,
    confirm: Confirm | None,
    only: Collection[str],
    clock: str,
    truth: str | Path | None = None,
) -> Opened:
    """Connect as `Cell.open` says, and raise what it says. What is to be undone if the rest fails goes to `undo`."""
    if sim not in (None, "all"):
        raise ConfigError(f'sim="{sim}" is not offered: "all" simulates the whole cell, leave it out for real devices')
    if clock not in ("wall", "virtual"):
        raise ConfigError(f'clock="{clock}" is not offered: "wall" keeps time with the wall, "virtual" does not wait')
    if clock == "virtual" and (sim is None or speed is not None):
        wrong = "speed means nothing on it" if sim else 'only a simulated cell, sim="all", has one'
        raise ConfigError(f'clock="virtual": {wrong}; leave that out')
    if truth is not None and sim is None:
        raise ConfigError("truth describes the cell that is simulated; without sim leave it out")
    path, loaded = config_to_open(None if config is None else Path(config), simulated=sim == "all", confirm=confirm)
    folder = beside(path)
    true = loaded if truth is None else load_config(Path(truth))
    # The world takes long to load, and real devices have none; over wires it is in another process.
    if clock == "virtual":
        from cell.devices.described import Described
        from cell.devices.direct import VirtualCell

        virtual = VirtualCell(loaded, seed, level, Described.of(job), true)
        return Opened(loaded, folder, nullcontext(), virtual.devices, virtual)
    simulated = None
    if sim == "all":
        from cell.devices.described import Described

        simulated = SimulatedCell(
            true, Described.of(job), seed=seed, level=level, speed=speed or SIM_SPEED, gige=on_gige(loaded)
        )
        undo.callback(simulated.close)
        loaded = with_endpoints(loaded, simulated.endpoints)
    needed = connected_for(loaded, only)
    lock = undo.enter_context(CellLock(loaded, needed))
    devices = connect(loaded, needed)
    undo.callback(devices.close)
    return Opened(loaded, folder, lock, devices, simulated)
