"""A job's dry run on the virtual clock, in a process of its own, so that a person sees what it would do.

Computed first, then shown: the virtual clock has no time of the wall. The run lies among the others, with its record.
Run as a module by the console: `python -m cell.apps.console.host.rehearsal JOB SEED LEVEL CONFIG`, in the cell's
folder.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from cell.config.files import CONFIGURATION
from drivers.errors import CellError, InterlockError
from statemachine.step import Event

if TYPE_CHECKING:
    from cell.run.session.supervisor import Cell

LONGEST_S = 600.0

log = logging.getLogger(__name__)


class Rehearsals:
    """The dry runs of one cell, one at a time; `present` is the newest as the page shows it, None before."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._cancelled = False
        self.present: dict[str, object] | None = None

    def begin(self, job: str, seed: int) -> str:
        """Begin one; `InterlockError` while another one is computed."""
        with self._lock:
            if self.present is not None and self.present["state"] == "running":
                raise InterlockError("cell", "another dry run is being computed; wait for it or cancel it")
            self._cancelled = False
            about = {"job": job, "seed": seed, "run": None}
            self.present = {"state": "running", "text": "starting", "fraction": 0.0, **about}
        threading.Thread(target=self._perform, args=(job, seed), name="console dry run", daemon=True).start()
        return f"the dry run of {job} is being computed"

    def cancel(self) -> str:
        """End the one that is computed; `InterlockError` when there is none."""
        with self._lock:
            if self.present is None or self.present["state"] != "running" or self._cancelled:
                raise InterlockError("cell", "no dry run is being computed; there is nothing to cancel")
            if self.present.get("by_command"):
                raise InterlockError("cell", "a command computes this dry run; end it there, with Ctrl+C")
        self.close()
        return "the dry run is cancelled"

    def close(self) -> None:
        """End the process that computes one, if there is one; idempotent."""
        with self._lock:
            self._cancelled = True
            if self._process is not None:
                self._process.kill()

    def _perform(self, job: str, seed: int) -> None:
        about = {"state": "done", "job": job, "seed": seed, "run": None}
        try:
            self.present = {**about, **self._computed(job, seed)}
        except Exception as error:  # Whatever it is: else it would count as running for good.
            outcome = "cancelled" if self._cancelled else "failed"
            log.warning("dry run of %s: %s: %s", job, outcome, error)
            self.present = {**about, "outcome": outcome, "reason": "" if self._cancelled else str(error)}

    def _computed(self, job: str, seed: int) -> dict[str, object]:
        cell = self._cell
        config = cell.folder / CONFIGURATION
        level = "nominal" if cell.simulated is None else str(cell.simulated.facts["level"])
        command = [sys.executable, "-m", __name__, job, str(seed), level, str(config) if config.is_file() else ""]
        with tempfile.TemporaryFile("w+") as complaints:
            try:
                with self._lock:
                    if self._cancelled:
                        raise CellError("it was cancelled")
                    # Gives way: the cell beside it may be moving. It ends when its input does, with this program.
                    process = self._process = subprocess.Popen(
                        ["nice", "-n", "10", *command],
                        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=complaints, text=True, errors="replace",
                        env=dict(os.environ, PYTHONPATH=os.pathsep.join(path or "." for path in sys.path)),
                    )  # fmt: skip
            except OSError as error:
                raise CellError(f"it could not be computed: {error}") from error
            watchdog = threading.Timer(LONGEST_S, process.kill)
            watchdog.daemon = True
            watchdog.start()
            try:
                told = self._heard(process)
            finally:
                watchdog.cancel()
                process.kill()
                process.communicate()
                with self._lock:
                    self._process = None
            complaints.seek(0)
            if told is None:
                raise CellError(f"it could not be computed: {complaints.read().strip()[-300:] or 'its process ended'}")
        if "error" in told:
            raise CellError(str(told["error"]))
        return told

    def _heard(self, process: subprocess.Popen[str]) -> dict[str, object] | None:
        """Show its progress until its last word, which is given; None when it ends without one."""
        for line in process.stdout or ():
            with suppress(ValueError, TypeError):
                told: dict[str, object] = json.loads(line)
                if "fraction" not in told:
                    return told
                self.present = {**(self.present or {}), **told}
        return None


def rehearse(job: str, seed: int, level: str, config: str) -> dict[str, object]:
    """The dry run itself, in this process: name, outcome and reason of the run."""

    def notify(fraction: float, text: str) -> None:
        print(json.dumps({"fraction": round(fraction, 3), "text": text}), flush=True)

    notify(0.0, "loading the program")
    from cell.config.job import load_job
    from cell.procedures.steps.kinds import kind_of
    from cell.run.session.supervisor import Cell

    notify(0.0, "simulating the cell")
    with Cell.open(
        Path(config) if config else None, sim="all", seed=seed, level=level, job=job, clock="virtual",
        confirm="simulated",
    ) as cell:  # fmt: skip
        names = kind_of(load_job(job)[0]).names

        def observe(event: Event) -> None:
            if event.step in names and event.kind in ("step_started", "progress"):
                within = float(str(event.data.get("fraction", 0.0)))
                notify((names.index(event.step) + within) / len(names), event.step.replace("_", " "))

        notify(0.0, "calibrating and planning")
        outcome = cell.run(job, observe)
    return {"run": outcome.folder.name, "outcome": outcome.outcome, "reason": outcome.reason}


def end_with_parent() -> None:
    """End this process when its input ends: so does the program that began it, in whatever way that ends."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, name="end with parent", daemon=True).start()


if __name__ == "__main__":
    end_with_parent()
    try:
        answer = rehearse(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4])
    except CellError as error:
        answer = {"error": str(error)}
    print(json.dumps(answer), flush=True)
