"""The line that says how well a job is qualified: kept for the job, shown by `cell run` while it holds."""

from __future__ import annotations

import os
from pathlib import Path

from cell.apps.qualify.answer import JobAnswer
from cell.apps.qualify.identity import configuration_hash
from cell.base.storage import read_json, sealed, write_json
from cell.config.cell_config import load_config
from cell.config.files import beside, find_config
from cell.config.job import job_and_item, job_path, ships
from cell.run.resumption import job_hash
from drivers.errors import CellError

FOLDER, SUFFIX = "qualified", ".qualified.json"


def line_file(job: str | Path, config: Path | None) -> Path:
    """Where the line of a job is: beside its file, or below the calibrations of a cell for a job that ships or whose
    folder cannot be written. `config` is the cell's file."""
    path, (_, number) = job_path(job), job_and_item(job)
    name = f"{path.stem}{'' if number is None else f'-{number}'}{SUFFIX}"
    if not ships(path) and os.access(path.parent, os.W_OK):
        return path.parent / name
    return beside(config) / load_config(config).cell.calibrations / FOLDER / name


def keep_line(answer: JobAnswer, job: str | Path, config: Path | None) -> Path:
    """Keep the line of an answer, with the hashes of what it is of; gives its file. Raises `OSError`."""
    file = line_file(job, config)
    file.parent.mkdir(parents=True, exist_ok=True)
    of = answer.of
    hashes = {"job_hash": of.job_hash, "configuration_hash": of.configuration_hash, "code_hash": of.code_hash}
    write_json(file, sealed({"line": answer.line, "job": of.job, **hashes}))
    return file


def kept_line(job: str | Path, config: Path | None) -> str | None:
    """The line of a job as it is now, or that it does not hold any more and why; None where nobody qualified it.

    `config` is the file that a command was given. Nothing is raised: what is wrong with the files is told elsewhere.
    """
    try:
        path = find_config(config, simulated=True)
        kept = read_json(line_file(job, path)).require()
        now = {"job": job_hash(job), "configuration": configuration_hash(load_config(path))}
    except (CellError, OSError, ValueError):
        return None
    changed = [name for name, value in now.items() if kept.get(f"{name}_hash") != value]
    if not changed:
        return str(kept.get("line"))
    verb = "has" if len(changed) == 1 else "have"
    return (
        f"{kept.get('line')}: that does not hold any more, {' and '.join(changed)} {verb} changed since; "
        f"`cell qualify {job}` tells anew"
    )
