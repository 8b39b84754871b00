"""A time in which a person has lifted interlocks, as a recorded run: which, for what reason, and how it ended."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cell.base.storage import sealed, write_json
from cell.base.version import release
from cell.run.files.folder import REPORT, new_run, when
from cell.run.files.logs import run_log
from drivers.errors import CellError
from statemachine.journal import Journal, JournalError


@contextmanager
def recorded_maintenance(root: Path, facts: Mapping[str, Any], reason: str, lift: Sequence[str]) -> Iterator[None]:
    """A run of kind "maintenance" below `root` for as long as the context is open. `CellError` if it cannot be kept."""
    started = time.time()
    facts = {"kind": "maintenance", "pid": os.getpid(), **facts, "maintenance": reason, "lifted": list(lift)}
    try:
        folder = new_run(root)
        journal = Journal(folder, folder.name, facts)
    except (OSError, JournalError) as error:
        raise CellError(f"no maintenance can be recorded in {root}, so nothing is lifted: {error}") from error
    outcome, said = "done", f"maintenance done: {reason}"
    try:
        with run_log(folder):
            yield
    except BaseException as error:
        outcome, said = "faulted", f"maintenance ({reason}) ended by {type(error).__name__}: {error}"
        raise
    finally:
        journal.run_ended(outcome, said)
        journal.close()
        ended = {"started": when(started), "ended": when(time.time()), "wall_s": round(time.time() - started, 2)}
        report = {"run": folder.name, "version": release(), "outcome": outcome, "reason": said, **ended, **facts}
        write_json(folder / REPORT, sealed(report))
