"""The runs of a cell as the page lists them; read from their folders, for whoever asks."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cell.run.folder import list_runs
from cell.run.reading import read_report, run_row
from cell.toml_file import below
from drivers.errors import CellError

RUN = re.compile(r"\d{8}T\d{6}-[0-9a-f]{4}")
PICTURE = re.compile(r"[\w][\w.+-]*\.png")
TRACE = "trace.json"
READ = ("report.json", "journal.sqlite")
MOST_RUNS, MOST_PICTURES = 200, 60
DRAW_S = 60.0
_DRAW = "import sys; from pathlib import Path; from cell.report.page.make import write_page; "
_DRAW += "from cell.console.rehearsal import end_with_parent; end_with_parent(); "
_DRAW += "write_page(Path(sys.argv[1]), Path(sys.argv[2]))"


class Archive:
    """Below the folder `root`. What is not there is None."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._rows: dict[Path, dict[str, Any]] = {}
        self._pages = tempfile.TemporaryDirectory(prefix="cell-console-")
        self._drawing = threading.Lock()

    def runs(self) -> list[dict[str, Any]]:
        """Newest first; see docs/console.md."""
        folders = reversed(list_runs(self._root)[-MOST_RUNS:])
        return [self._row(folder) for folder in folders if self._folder(folder.name) is not None]

    def trend(self) -> list[dict[str, Any]]:
        """Jobs, oldest first."""
        keys = ("run", "started", "job", "outcome", "d_mean_mm", "expected_mm", "duration_s")
        return [{key: row[key] for key in keys} for row in reversed(self.runs()) if row["kind"] == "job"]

    def run(self, name: str) -> dict[str, Any] | None:
        """One run's report and the names of its pictures."""
        if (folder := self._folder(name)) is None:
            return None
        try:
            report: dict[str, Any] = read_report(folder)
        except CellError as error:
            report = {"outcome": "unreadable", "reason": str(error)}
        own = sorted(path.name for path in folder.glob("*.png"))
        last = [str(name).rpartition("/")[2] for name in report.get("last_frames") or ()]
        kept = sorted(path.name for path in (folder / "frames").glob("*.png") if not path.name.startswith("stripe"))
        names = [name for name in dict.fromkeys((*own, *last, *kept)) if self.picture(folder.name, name) is not None]
        return {"run": folder.name, "report": report, "pictures": names[:MOST_PICTURES]}

    def picture(self, run: str, name: str) -> Path | None:
        """The file of a picture."""
        folder = self._folder(run)
        if folder is None or not PICTURE.fullmatch(name):
            return None
        return below(self._root, folder.name, name) or below(self._root, folder.name, "frames", name)

    def page(self, name: str) -> Path | None:
        """The report as one HTML file, drawn by a process of its own that gives way; None where it cannot be drawn."""
        folder = self._folder(name)
        # What draws it reads whatever lies there.
        if folder is None or any(path.is_symlink() for path in folder.rglob("*")):
            return None
        page = Path(self._pages.name) / f"{name}.html"
        with self._drawing:
            if not page.exists() and not self._drawn(folder, page):
                return None
            if not (folder / "report.json").exists():
                # A run that goes on is drawn anew each time.
                return page.rename(page.with_suffix(".now.html"))
        return page

    def _drawn(self, folder: Path, page: Path) -> bool:
        command, nowhere = ["nice", "-n", "10", sys.executable, "-c", _DRAW, str(folder), str(page)], subprocess.DEVNULL
        try:
            with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=nowhere, stderr=nowhere) as process:
                try:
                    return process.wait(DRAW_S) == 0
                finally:
                    process.kill()
        except (OSError, subprocess.TimeoutExpired):
            return False

    def replay(self, name: str) -> dict[str, Any] | None:
        """How the cell moved in a run; None for one that left no trace."""
        folder = self._folder(name)
        path = None if folder is None else below(self._root, folder.name, TRACE)
        try:
            trace = None if path is None else json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return None
        return {"run": name, **trace} if isinstance(trace, dict) else None

    def _folder(self, name: str) -> Path | None:
        """The folder of a run; none that is a link, or whose report or journal is no file of its own."""
        folder = self._root / name
        if not RUN.fullmatch(name) or folder.is_symlink() or not folder.is_dir():
            return None
        read = [folder / file for file in READ if (folder / file).is_symlink() or (folder / file).exists()]
        return folder if all(below(self._root, name, path.name) for path in read) else None

    def _row(self, folder: Path) -> dict[str, Any]:
        if (known := self._rows.get(folder)) is not None:
            return known
        row = run_row(folder)
        try:
            report = read_report(folder)
        except (CellError, OSError):
            report = {}
        row |= {"d_mean_mm": _true(report), "expected_mm": _stated(report)}
        if (folder / "report.json").exists():
            self._rows[folder] = row
        return row


def _true(report: Mapping[str, Any]) -> float | None:
    try:
        return float(report["truth"]["error_mm"]["d"]["mean"])
    except (KeyError, TypeError, ValueError):
        return None


def _stated(report: Mapping[str, Any]) -> float | None:
    """One standard deviation of the surface's place, all directions together."""
    try:
        return round(math.hypot(*(float(value) for value in report["place_sigma"]["translation_mm"])), 4)
    except (KeyError, TypeError, ValueError):
        return None
