"""A job's dry run on the virtual clock, in a process of its own, so that a person sees what it would do.

Computed first, then shown: the virtual clock has no time of the wall. The run lies among the others, with its trace.
Run as a module by the console: `python -m cell.console.rehearsal JOB SEED LEVEL CONFIG`, in the cell's folder.
"""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.errors import CellError, InterlockError

if TYPE_CHECKING:
    from cell.supervisor import Cell

LONGEST_S = 600.0
_ONE = threading.Lock()

log = logging.getLogger(__name__)


def rehearse_job(cell: Cell, job: str, seed: int) -> dict[str, Any]:
    """Do it, and wait for it: `run` is its folder's name. `CellError` when it could not be done."""
    if not _ONE.acquire(blocking=False):
        raise InterlockError("cell", "another dry run is being computed; wait for it")
    try:
        where = cell.folder / "cell.toml"
        config = str(where) if where.is_file() else ""
        level = cell.simulated.facts.get("level") if cell.simulated is not None else None
        command = [sys.executable, "-m", "cell.console.rehearsal", job, str(seed), str(level or "nominal"), config]
        # It works beside a cell that may be moving: that comes first.
        done = subprocess.run(
            ["nice", "-n", "10", *command], cwd=cell.folder, capture_output=True, text=True, timeout=LONGEST_S,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CellError(f"the dry run could not be computed: {error}") from error
    finally:
        _ONE.release()
    lines = done.stdout.strip().splitlines()
    try:
        told: dict[str, Any] = json.loads(lines[-1])
    except (IndexError, ValueError):
        raise CellError(f"the dry run could not be computed: {done.stderr.strip()[-300:]}") from None
    if "error" in told:
        raise CellError(str(told["error"]))
    return {"text": f"dry run of {job}, seed {seed}: {told['outcome']}: {told['reason']}", **told}


def rehearse(job: str, seed: int, level: str, config: str) -> dict[str, Any]:
    """The dry run itself, in this process: name, outcome and reason of the run."""
    from cell.console.trace import Trace
    from cell.supervisor import Cell

    with Cell.open(
        Path(config) if config else None, sim="all", seed=seed, level=level, job=job, clock="virtual",
        confirm="simulated",
    ) as cell:  # fmt: skip
        trace = Trace(cell.devices)
        with trace.taken():
            outcome = cell.run(job, trace)
        trace.write(outcome.folder)
    return {"run": outcome.folder.name, "outcome": outcome.outcome, "reason": outcome.reason}


if __name__ == "__main__":
    try:
        answer = rehearse(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4])
    except CellError as error:
        answer = {"error": str(error)}
    print(json.dumps(answer))
