"""A job's dry run on the virtual clock, in a process of its own, so that a person sees what it would do.

Computed first, then shown: the virtual clock has no time of the wall. The run lies among the others, with its record.
Run as a module by the console: `python -m cell.console.rehearsal JOB SEED LEVEL CONFIG`, in the cell's folder.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cell.config import CONFIGURATION
from drivers.errors import CellError, InterlockError

if TYPE_CHECKING:
    from cell.supervisor import Cell

LONGEST_S = 600.0

log = logging.getLogger(__name__)


class Rehearsals:
    """The dry runs of one cell, one at a time; `present` is the newest as the page shows it, None before."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._lock = threading.Lock()
        self.present: dict[str, Any] | None = None

    def begin(self, job: str, seed: int) -> str:
        """Begin one; `InterlockError` while another one is computed."""
        with self._lock:
            if self.present is not None and self.present["state"] == "running":
                raise InterlockError("cell", "another dry run is being computed; wait for it")
            self.present = {"state": "running", "job": job, "seed": seed, "text": "computing", "run": None}
        threading.Thread(target=self._perform, args=(job, seed), name="console dry run", daemon=True).start()
        return f"the dry run of {job} is being computed"

    def _perform(self, job: str, seed: int) -> None:
        about = {"state": "done", "job": job, "seed": seed, "run": None}
        try:
            self.present = {**about, **self._computed(job, seed)}
        except CellError as error:
            log.warning("dry run of %s: %s", job, error)
            self.present = {**about, "outcome": "failed", "reason": str(error)}

    def _computed(self, job: str, seed: int) -> dict[str, Any]:
        cell = self._cell
        config = cell.folder / CONFIGURATION
        level = "nominal" if cell.simulated is None else str(cell.simulated.facts["level"])
        command = [sys.executable, "-m", __name__, job, str(seed), level, str(config) if config.is_file() else ""]
        try:
            # Gives way: the cell beside it may be moving.
            done = subprocess.run(
                ["nice", "-n", "10", *command],
                capture_output=True, text=True, timeout=LONGEST_S, stdin=subprocess.DEVNULL,
                env=dict(os.environ, PYTHONPATH=os.pathsep.join(path or "." for path in sys.path)),
            )  # fmt: skip
            told: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
        except (OSError, subprocess.TimeoutExpired) as error:
            raise CellError(f"it could not be computed: {error}") from error
        except (IndexError, ValueError):
            raise CellError(f"it could not be computed: {done.stderr.strip()[-300:]}") from None
        if "error" in told:
            raise CellError(str(told["error"]))
        return told


def rehearse(job: str, seed: int, level: str, config: str) -> dict[str, Any]:
    """The dry run itself, in this process: name, outcome and reason of the run."""
    from cell.supervisor import Cell

    with Cell.open(
        Path(config) if config else None, sim="all", seed=seed, level=level, job=job, clock="virtual",
        confirm="simulated",
    ) as cell:  # fmt: skip
        outcome = cell.run(job)
    return {"run": outcome.folder.name, "outcome": outcome.outcome, "reason": outcome.reason}


if __name__ == "__main__":
    try:
        answer = rehearse(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4])
    except CellError as error:
        answer = {"error": str(error)}
    print(json.dumps(answer))
