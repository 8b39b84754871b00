"""`cell jog` without words: the cell is opened for a person at this terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path

from cell.cli.options import Level
from drivers.errors import ConfigError

JOGGED = ("rail", "arm", "vehicle")


def jog_by_keys(
    config: Path | None,
    job: str,
    sim: str | None,
    seed: int,
    level: Level,
    lifted: Sequence[str],
    reason: str,
    json: bool,
) -> None:
    """Open the devices that move and show the jog screen until it is left."""
    if json or not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ConfigError(
            "without a device and a motion `cell jog` needs a terminal to jog by keys; write what to move, such as "
            "`cell jog arm z +5mm`"
        )
    from cell.job import load_job
    from cell.supervisor import Cell
    from cell.terminal.jog_screen import JogScreen
    from cell.terminal.screen import opened

    loaded, _ = load_job(job)
    with (
        Cell.open(config, sim=sim, seed=seed, level=level.value, job=job, only=JOGGED) as cell,
        cell.maintenance(reason, list(lifted)) if lifted else nullcontext(),
        opened(sys.stdin.fileno(), sys.stdout.fileno()) as screen,
    ):
        JogScreen(cell, loaded, screen).run()
    with suppress(OSError):
        os.write(sys.stdout.fileno(), b"left the jog screen; nothing moves\n")
