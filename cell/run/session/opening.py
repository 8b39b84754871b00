"""Opening a cell: its devices, real or simulated, over wires or on the virtual clock, and the lock that holds them."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import ExitStack, nullcontext
from pathlib import Path

from cell.config.cell_config import DEVICES, Confirm, beside, config_to_open, load_config, require_real_addresses
from cell.devices.assembly import connect, connected_for
from cell.devices.lock import CellLock
from cell.devices.simulated.mix import Sim, simulated_of
from cell.devices.simulated.process import SimulatedCell, on_gige, with_endpoints
from cell.run.session.session import Opened
from drivers.errors import ConfigError, NotConnectedError

SIM_SPEED = 3.0
"""How many times faster than the wall a simulated cell runs unless told otherwise."""


def open_devices(
    undo: ExitStack,
    config: str | Path | None,
    *,
    sim: Sim,
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
    if clock not in ("wall", "virtual"):
        raise ConfigError(f'clock="{clock}" is not offered: "wall" keeps time with the wall, "virtual" does not wait')
    given = None if config is None else Path(config)
    names = simulated_of(sim, given)
    whole = set(names) == set(DEVICES)
    if clock == "virtual" and (not whole or speed is not None):
        wrong = "speed means nothing on it" if whole else 'only a simulated cell, sim="all", has one'
        raise ConfigError(f'clock="virtual": {wrong}; leave that out')
    if truth is not None and not whole:
        raise ConfigError("truth describes a cell that is all simulated; leave it out where devices are real")
    path, loaded = config_to_open(given, simulated=whole, confirm=confirm)
    # So that whatever keeps the configuration keeps what was simulated.
    loaded = loaded.model_copy(update={"cell": loaded.cell.model_copy(update={"sim": names})})
    folder = beside(path)
    true = loaded if truth is None else load_config(Path(truth))
    # The world takes long to load, and real devices have none; over wires it is in another process.
    if clock == "virtual":
        from cell.devices.simulated.described import Described
        from cell.devices.simulated.direct import VirtualCell

        virtual = VirtualCell(loaded, seed, level, Described.of(job), true)
        return Opened(loaded, folder, nullcontext(), virtual.devices, virtual)
    needed = connected_for(loaded, only)
    for name in needed:
        if missing := (whole or name not in names) and loaded.make(name).missing():
            raise NotConnectedError(name, missing)
    world: SimulatedCell | None = None
    if whole:
        from cell.devices.simulated.described import Described
        from cell.measure.vision.stripe.warm_up import read_drawn

        world = SimulatedCell(
            true,
            Described.of(job),
            seed=seed,
            level=level,
            speed=speed or SIM_SPEED,
            gige=on_gige(loaded),
            meanwhile=read_drawn if set(only) == set(DEVICES) else None,
        )
        undo.callback(world.close)
        loaded = with_endpoints(loaded, world.endpoints)
    else:
        require_real_addresses(loaded, names)
    if beside_real := tuple(name for name in names if name in needed and not whole):
        from cell.devices.simulated.mixed import MixedCell

        if speed not in (None, loaded.cell.time_scale):
            raise ConfigError(f"speed={speed:g}: real devices keep the wall's time; leave that out")
        mixed = MixedCell(undo, loaded, job, seed=seed, level=level, simulated=beside_real, needed=needed)
        return Opened(mixed.config, folder, mixed.lock, mixed.devices, mixed.world)
    lock = undo.enter_context(CellLock(loaded, needed))
    devices = connect(loaded, needed)
    undo.callback(devices.close)
    return Opened(loaded, folder, lock, devices, world)
