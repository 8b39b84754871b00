"""The rows of campaigns in a folder, as Parquet: appended one by one, so that a kill loses none that was written.

Each row is a small file at first, written under another name and renamed. Now and then small files are folded into a
larger one, and removed after it is there. A kill in between leaves rows twice: a reader drops those by their key.
"""

from __future__ import annotations

import fcntl
import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from cell.apps.qualify.rows import TEXTS, WHOLE, Row
from cell.base.storage import replacing
from drivers.errors import CellError, ConfigError

if TYPE_CHECKING:
    import pyarrow

ROWS = "rows"
FOLD = "fold-"
"""How the name of a larger file begins, followed by its number of rows."""
SMALL = 256
"""A file with fewer rows is folded; so many small files are folded at once."""


def require_installed() -> None:
    """`ConfigError` where the package is missing that writes Parquet."""
    if find_spec("pyarrow") is None:
        raise ConfigError("the rows of a campaign need pyarrow; install: pip install -e '.[qualify]'")


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
        """Each row once whose columns have the `wanted` values; columns that a row does not have are left out.

        Raises `CellError` for a file that is none of Parquet.
        """
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
    """All columns of all rows, in the order in which they come; figures are numbers of 64 bits."""
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
