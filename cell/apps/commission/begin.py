"""Everything that a commissioning begins with: which cell, which person, where its record is."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from cell.apps.commission.check import CommissionCheck, Result
from cell.apps.commission.person import Person
from cell.apps.commission.progress import Progress
from cell.apps.commission.sequence import Commissioning
from cell.apps.commission.workplace import CommissionWorkplace
from cell.config.cell_config import CONFIGURATION, load_config, require_confirm
from cell.config.job import job_path
from cell.run.session.supervisor import Cell
from drivers.errors import ConfigError

FOLDER = "commissioning"


def begin(
    config: Path | None,
    person: Person,
    show: Callable[[CommissionCheck, str, Result | None], None],
    *,
    job: str,
    sim: str | None = None,
    seed: int = 1,
    level: str = "nominal",
    clock: str = "wall",
    truth: Path | None = None,
) -> Commissioning:
    """A commissioning of the cell of this configuration, whose record is in `commissioning/` beside it.

    With `sim="all"` the cell is simulated, as `truth` describes it. `ConfigError` for what is wrong before anything is
    connected. The caller closes `desk`.
    """
    path = Path(CONFIGURATION) if config is None else config
    if not path.is_file():
        raise ConfigError(
            f"there is no {path} to commission: `cell init` writes one; put in what you know, addresses first. Or try "
            "it with a simulated cell: `cell init`, then `cell commission --sim all`"
        )
    loaded = load_config(path)
    if sim is None:
        require_confirm(loaded)
    if truth is not None:
        load_config(truth)
    job_path(job)
    options: dict[str, Any] = {"sim": sim, "job": job}
    simulated = sim == "all" or (sim is None and bool(loaded.cell.truth))
    which: dict[str, Any] = {"name": loaded.cell.name, "simulated": simulated, "sim": sim, "job": job}
    if sim is not None:
        options |= {"seed": seed, "level": level, "clock": clock, "truth": truth}
        world = "" if truth is None else hashlib.sha256(truth.read_bytes()).hexdigest()[:12]
        which |= {"seed": seed, "level": level, "clock": clock, "world": world}
    folder = path.resolve().parent / FOLDER
    desk = CommissionWorkplace(path, partial(Cell.open, path, **options), person, folder, job, simulated=simulated)
    return Commissioning(desk, Progress(folder, which, desk.job), path, show)


def confirms_itself(config: Path | None) -> bool:
    """Whether the configuration names a simulated cell that confirms by itself what a person has to."""
    path = Path(CONFIGURATION) if config is None else config
    return path.is_file() and load_config(path).cell.confirm == "simulated"
