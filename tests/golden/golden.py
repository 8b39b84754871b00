"""Hashes of what jobs on the virtual clock leave behind: code that is only moved or renamed must not change them.

`python -m tests.golden.golden write` makes `hashes.json` beside this file, `compare` tells what differs from it.
A hash is that of a report and a journal without the run's name, dates and process, and without the checkout's folder.
Another kind of processor or another release of a numerical library may round differently: write on the machine on
which you compare.
"""

import argparse
import hashlib
import json
import re
import sqlite3
import sys
import tempfile
from collections.abc import Iterator
from contextlib import chdir, closing
from itertools import product
from pathlib import Path
from typing import Any

from cell import Cell

HASHES = Path(__file__).with_name("hashes.json")
CHECKOUT = f"{Path(__file__).parents[2]}/"
JOBS, LEVELS, SEEDS = ("pot", "seat", "panel"), ("nominal", "workshop"), range(1, 7)
_DATED = re.compile(r'"(run|started|ended|at|calibration_date)": "[^"]*"')
_TABLES = (
    "SELECT info, outcome, reason FROM runs",
    "SELECT id, name, attempt, state, duration_s, result, error FROM steps",
    "SELECT id, kind, step, data FROM events",
    "SELECT id, kind, reason FROM requests",
)


def plain_report(folder: Path) -> str:
    """The text of the report without the run's name, its dates, and its own digest, which covers the mesh's path."""
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    report.pop("sha256", None)
    return _DATED.sub(r'"\1": ""', json.dumps(report))


def plain_journal(folder: Path) -> list[Any]:
    """All rows of the journal without the run's id, its process, all times and dates."""
    with closing(sqlite3.connect(folder / "journal.sqlite")) as base:
        rows = [base.execute(table).fetchall() for table in _TABLES]
    return [
        [[_DATED.sub(r'"\1": ""', value) if isinstance(value, str) else value for value in row] for row in table]
        for table in rows
    ]


def hashes() -> Iterator[tuple[str, str]]:
    """Name and hash of each job; each cell is calibrated once for all its jobs."""
    for seed, level in product(SEEDS, LEVELS):
        how = {"sim": "all", "seed": seed, "level": level, "clock": "virtual", "confirm": "simulated"}
        with tempfile.TemporaryDirectory() as folder, chdir(folder):
            for job in JOBS:
                with Cell.open(job=job, **how) as cell:
                    outcome = cell.run(job)
                told = plain_report(outcome.folder) + json.dumps(plain_journal(outcome.folder))
                yield f"{job} {level} {seed}", hashlib.sha256(told.replace(CHECKOUT, "").encode()).hexdigest()


def main() -> int:
    """0 when nothing differs; progress goes to the standard error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("write", "compare"))
    kept = {} if parser.parse_args().what == "write" else json.loads(HASHES.read_text(encoding="utf-8"))
    found: dict[str, str] = {}
    for name, value in hashes():
        found[name] = value
        print(f"{name:20} {'same' if kept.get(name, value) == value else 'DIFFERS'}", file=sys.stderr, flush=True)
    if not kept:
        HASHES.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return int(any(kept.get(name, value) != value for name, value in found.items()))


if __name__ == "__main__":
    sys.exit(main())
