"""Rows of campaigns without their worlds, and worlds that cost nothing: for the tests of `cell qualify`."""

import os
import signal
from pathlib import Path

from cell.apps.qualify.campaign import Campaign, Target
from cell.apps.qualify.identity import QualifiedCode
from cell.apps.qualify.rows import Row, Value
from cell.apps.qualify.world import WorldTask

OF = QualifiedCode("pot", "job1", "configuration1", "code1")
ERROR = "place error, largest of 45 points [mm]"
COVERED = "surface covered [%]"


def row(seed: int, outcome: str = "placed", error_mm: float = 0.1, of: QualifiedCode = OF, **values: Value) -> Row:
    """A row as a world leaves it; one that placed has a figure with its limit."""
    made: Row = {
        "key": of.key("nominal", seed), "job": of.job, "job_hash": of.job_hash,
        "configuration_hash": of.configuration_hash, "code_hash": of.code_hash, "level": "nominal", "seed": seed,
        "schedule": "", "outcome": outcome, "step": "", "code": "", "reason": "", "cycle_s": 50.0 + seed,
        "corrections": 0, "faults": 0, "tolerance_mm": 0.6, "wall_s": 1.0, "ended_s": 1e9 + seed,
    }  # fmt: skip
    if outcome == "placed":
        made |= {
            ERROR: error_mm, f"{ERROR} at most": 0.6, COVERED: 95.0 - seed, f"{COVERED} at least": 35.0,
            "true_error_max_mm": error_mm, "points_covered": 1.0, "step_place_s": 20.0, "step_laser_sweep_s": 10.0,
        }  # fmt: skip
    return made | values


def campaign(folder: Path, target: Target, first: int = 1, of: QualifiedCode = OF) -> Campaign:
    """A campaign whose worlds are not run by the product."""
    return Campaign(of, "pot.toml", "", folder, level="nominal", first=first, target=target)


def quick(task: WorldTask) -> Row:
    """A world that costs nothing: every tenth is refused."""
    return row(task.seed, "refused" if task.seed % 10 == 0 else "placed", 0.01 * task.seed, of=task.of)


def deadly(task: WorldTask) -> Row:
    """As `quick`; world 3 kills each process that runs it, world 5 the first one."""
    once = task.folder / "killed"
    if task.seed == 3 or (task.seed == 5 and not once.exists()):
        task.folder.mkdir(exist_ok=True)
        if task.seed == 5:
            once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return quick(task)


def other_code(task: WorldTask) -> Row:
    """A worker that has another code."""
    from drivers.errors import ConfigError

    raise ConfigError("a worker has another code")


def compared(row: Row) -> Row:
    """Those columns of a row that are the same each time; what is not known is left out."""
    return {name: value for name, value in row.items() if name not in ("wall_s", "ended_s") and value is not None}
