"""A world as a row: flat, with units in the names of its columns, the same bit for bit wherever it was run.

A world whose job has several items is one row: it is as good as its worst item, and each figure is the one nearest its
limit. Rows lie in a folder, as Parquet: appended one by one, so that a kill loses none that was written. Each is a
small file at first, written under another name and renamed. Now and then small files are folded into a larger one, and
removed after it is there. A kill in between leaves rows twice: a reader drops those by their key.
"""

from __future__ import annotations

import fcntl
import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from cell.apps.qualify.identity import QualifiedCode
from cell.base.storage import replacing
from cell.run.batch import GOOD
from cell.run.folder import Report
from drivers.errors import CellError, ConfigError, MeasuredRow

if TYPE_CHECKING:
    import pyarrow


Value = str | int | float | bool | None
Row = dict[str, Value]
"""A row by the names of its columns; what is not known of a world is missing, or None."""
BOUNDS = {"at most": " at most", "at least": " at least"}
"""What a figure is held against, and how the column of its limit ends, after the figure's own name."""
TEXTS = ("key", "job", "job_hash", "configuration_hash", "code_hash", "level", "schedule", "outcome", "step", "code")
WHOLE = ("seed", "parts", "corrections", "retries", "faults")
WORST_FIRST = ("error", "aborted", "faulted", "misplaced", "refused")


def row_of(of: QualifiedCode, level: str, seed: int, reports: Sequence[Report], covered: float | None = None) -> Row:
    """The row of a world whose runs left these `reports`, one for each item that was tried. `covered` is the share of
    the part's points that ended within the stated bound."""
    worst = next((one for name in WORST_FIRST for one in reports if one["outcome"] == name), reports[-1])
    row = _first(of, level, seed) | {
        "outcome": str(worst["outcome"]), "step": _ended_in(worst), "code": str(worst.get("code") or ""),
        "reason": "" if worst["outcome"] in GOOD else str(worst["reason"]), "parts": len(reports),
        "corrections": max(_corrections(one) for one in reports), "faults": sum(len(one["faults"]) for one in reports),
        "retries": sum(int(step["retries"]) for one in reports for step in one["steps"]),
        "cycle_s": round(sum(float(one["cell_s"]) for one in reports), 3),
        "tolerance_mm": min(float(one["tolerance"]["translation_mm"]) for one in reports),
        "points_covered": covered,
    }  # fmt: skip
    for one in reports:
        _keep_worst(row, _truth(one), "true_error_max_mm")
        for step in one["steps"]:
            name = f"step_{step['name']}_s"
            row[name] = round(number(row.get(name)) + float(step["duration_s"]), 3)
        for figure in one["measured"]:
            _keep_nearer(row, figure)
    return row


def error_row(of: QualifiedCode, level: str, seed: int, *, outcome: str, step: str, code: str, reason: str) -> Row:
    """The row of a world that came to no report."""
    return _first(of, level, seed) | {"outcome": outcome, "step": step, "code": code, "reason": reason}


def _first(of: QualifiedCode, level: str, seed: int) -> Row:
    return {
        "key": of.key(level, seed), "job": of.job, "job_hash": of.job_hash,
        "configuration_hash": of.configuration_hash, "code_hash": of.code_hash, "level": level, "seed": seed,
        "schedule": "",
    }  # fmt: skip


def _ended_in(report: Report) -> str:
    failed = [str(step["name"]) for step in report["steps"] if step["state"] == "failed"]
    return failed[-1] if failed else ""


def _corrections(report: Report) -> int:
    seen = next((step["result"] or {} for step in report["steps"] if step["name"] == "verify"), {})
    return len(seen.get("before_mm") or ())


def _truth(report: Report) -> Row:
    truth, bound = report.get("truth"), report.get("place_bound_95")
    stated: Row = {} if bound is None else {"stated_bound_mm": float(bound["d"])}
    if truth is None:
        return stated
    error = truth["error_mm"]["d"]
    return stated | {
        "true_error_mean_mm": float(error["mean"]), "true_error_p95_mm": float(truth["d_p95"]),
        "true_error_max_mm": float(error["max"]),
    }  # fmt: skip


def _keep_worst(row: Row, found: Row, by: str) -> None:
    """Take the columns of `found` as a whole, where `by` is larger there than in the row."""
    if by not in row or number(found.get(by)) > number(row[by]):
        row |= found


def _keep_nearer(row: Row, figure: MeasuredRow) -> None:
    """Take a figure with its limit, unless the row has it nearer to its limit already."""
    name, value, limit = column(figure["name"], figure["unit"]), figure["value"], figure["limit"]
    if value is None:
        return
    end = BOUNDS.get(figure["bound"] or "")
    if end is None or limit is None:
        row.setdefault(name, float(value))
        return
    before, was = row.get(name), row.get(name + end)
    if before is None or was is None or used(name, value, limit, end) > used(name, number(before), number(was), end):
        row |= {name: float(value), name + end: float(limit)}


def used(name: str, value: float, limit: float, end: str) -> float:
    """The share of its limit that a value of this column uses, 1 at the limit; `end` is that of the limit's column. A
    share in % that has to be large is as good as can be at 100."""
    if end == BOUNDS["at most"]:
        return abs(value) / limit if limit else float(value != 0.0)
    if shown(name)[1] == "%" and limit < 100.0:
        return (100.0 - value) / (100.0 - limit)
    return limit / max(value, 1e-12)


def column(name: str, unit: str) -> str:
    """The name of a figure's column: its own, and its unit."""
    return f"{name} [{unit or 1}]"


def shown(name: str) -> tuple[str, str]:
    """A column for people: its words, and its unit."""
    if (figure := re.fullmatch(r"(.*) \[(.*)\]", name)) is not None:
        return figure[1], "" if figure[2] == "1" else figure[2]
    words, _, unit = name.rpartition("_")
    return words.replace("_", " "), unit


def number(value: Value) -> float:
    """A value as a number; 0 where it is none."""
    return float(value) if isinstance(value, int | float) else 0.0


ROWS = "rows"
FOLD = "fold-"
"""How the name of a larger file begins, followed by its number of rows."""
SMALL = 256
"""A file with fewer rows is folded; so many small files are folded at once."""


def require_installed() -> None:
    """`ConfigError` where the package is missing that writes Parquet."""
    if find_spec("pyarrow") is None:
        raise ConfigError("the rows of a campaign need pyarrow; in the checkout: pip install -e '.[qualify]'")


class RowStore:
    """The rows below `folder`; one process at a time writes there, inside `writing()`."""

    def __init__(self, folder: Path) -> None:
        """The folder is made. Raises `ConfigError` where that cannot be, or pyarrow is missing."""
        require_installed()
        self.folder = folder / ROWS
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out {folder} cannot be made: {error.strerror}; name another folder") from error
        self._small = len(self._files(small=True))

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Hold the folder, and fold its small files at the end. `ConfigError` while another campaign holds it."""
        # Beside the rows: others read all files among them as Parquet.
        with (self.folder.parent / "lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ConfigError(
                    f"another campaign writes into {self.folder.parent}; wait for its end, or name another --out"
                ) from None
            for left in self.folder.glob("*.tmp"):
                left.unlink(missing_ok=True)
            try:
                yield
            finally:
                self.fold()

    def append(self, row: Row) -> None:
        """Keep a row; it is on the disk when this returns. Raises `OSError` for a full disk: nothing is lost."""
        self._write([row], f"{row['key']}.parquet")
        self._small += 1
        if self._small >= SMALL:
            self.fold()

    def fold(self) -> None:
        """Make one file of the small ones."""
        small = self._files(small=True)
        if len(small) > 1:
            rows = list({str(row["key"]): row for row in _read(small)}.values())
            named = hashlib.sha256("".join(sorted(str(row["key"]) for row in rows)).encode()).hexdigest()[:12]
            kept = self._write(rows, f"{FOLD}{len(rows):06d}-{named}.parquet")
            for path in small:
                if path != kept:
                    path.unlink(missing_ok=True)
        self._small = len(self._files(small=True))

    def rows(self, **wanted: str) -> list[Row]:
        """Each row once whose columns have the `wanted` values; columns that a row does not have are left out. Raises
        `CellError` for a file that is none of Parquet."""
        found: dict[str, Row] = {}
        for row in _read(self._files()):
            if all(row.get(name) == value for name, value in wanted.items()):
                found[str(row["key"])] = row
        return list(found.values())

    def outcomes(self, **wanted: str) -> dict[int, str]:
        """The outcome of each of these worlds by its seed."""
        columns = ["key", "seed", "outcome", *wanted]
        found = (row for row in _read(self._files(), columns) if all(row[name] == wanted[name] for name in wanted))
        return {int(str(row["seed"])): str(row["outcome"]) for row in found}

    def _files(self, *, small: bool = False) -> list[Path]:
        """Larger files first, whose columns are those of many rows: readers take the columns of the first file."""
        files = sorted(self.folder.glob("*.parquet"), key=lambda path: (not path.name.startswith(FOLD), path.name))
        return [path for path in files if _count(path) < SMALL] if small else files

    def _write(self, rows: Sequence[Row], name: str) -> Path:
        import pyarrow.parquet

        with replacing(self.folder / name) as file:
            pyarrow.parquet.write_table(_table(rows), file)
        return self.folder / name


def _count(path: Path) -> int:
    """Rows of a file, by its name."""
    return int(path.name.split("-")[1]) if path.name.startswith(FOLD) else 1


def _table(rows: Sequence[Mapping[str, object]]) -> pyarrow.Table:
    import pyarrow

    kinds = {**dict.fromkeys((*TEXTS, "reason"), pyarrow.string()), **dict.fromkeys(WHOLE, pyarrow.int64())}
    names = dict.fromkeys(name for row in rows for name in row)
    fields = [pyarrow.field(name, kinds.get(name, pyarrow.float64())) for name in names]
    return pyarrow.Table.from_pylist([dict(row) for row in rows], schema=pyarrow.schema(fields))


def _read(files: Iterable[Path], columns: Sequence[str] | None = None) -> Iterator[Row]:
    import pyarrow
    import pyarrow.parquet

    for path in files:
        try:
            # Not as a data set: its columns would be those of the first file.
            table = pyarrow.parquet.ParquetFile(path).read(columns)
        except FileNotFoundError:
            continue
        except (OSError, pyarrow.ArrowInvalid) as error:
            raise CellError(f"{path} is no Parquet file: {error}; remove it, its worlds are then run again") from error
        for row in table.to_pylist():
            yield {name: value for name, value in row.items() if value is not None}
