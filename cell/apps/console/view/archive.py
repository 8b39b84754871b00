"""The runs of a cell as the page lists them, and how the cell moved in one, for the replay: read from their folders.

The server reads a record in a process of its own: `python -m cell.apps.console.view.archive FILE`.
"""

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

from cell.apps.console.host.rehearsal import end_with_parent
from cell.base.toml_file import below
from cell.run.folder import list_runs, read_report, run_row
from cell.run.record.file import FILE
from cell.run.record.reading import Parts, messages, said
from drivers.errors import CellError

JOINTS, VEHICLE, EVENT = "/joints", "/vehicle/state", "/sequence/event"
RAIL = "rail"
PERIOD_S, MOST = 0.1, 40_000
"""Seconds between two moments that are kept, and how many are at most: more than an hour."""


def moves(record: Path) -> bool:
    """Whether a record tells where the arm was, so that it can be replayed."""
    try:
        return next(said(record, Parts(), (JOINTS,)), None) is not None
    except (CellError, OSError):
        return False


def motion(record: Path) -> dict[str, object]:
    """Ten times a second from the record's beginning, as docs/reference/console.md has it: joints in rad, rail in m,
    vehicle in m and rad; None where not told yet. Raises `CellError` for a file that is no record."""
    told = sorted(messages(record, (JOINTS, VEHICLE, EVENT)), key=lambda message: message[1])
    begun = told[0][1] if told else 0
    rows: list[tuple[float, list[float] | None, float | None, list[float] | None]] = []
    steps: list[dict[str, object]] = []
    joints: list[float] | None = None
    rail: float | None = None
    vehicle: list[float] | None = None
    for topic, at, message in told:
        now = round(1e-9 * (at - begun), 3)
        if topic == EVENT:
            _note_step(steps, message, now)
            continue
        if topic == VEHICLE:
            vehicle = [round(float(message[key]), 5) for key in ("x", "y", "yaw")]
        elif [joint.name for joint in message.joints] == [RAIL]:
            rail = round(message.joints[0].position, 6)
        else:
            joints = [round(joint.position, 5) for joint in message.joints if joint.name != RAIL]
        row = now, joints, rail, vehicle
        # The newest of each tenth of a second.
        if rows and int(rows[-1][0] / PERIOD_S) == int(now / PERIOD_S):
            rows[-1] = row
        elif len(rows) < MOST:
            rows.append(row)
    columns = [list(column) for column in zip(*rows, strict=True)] or [[], [], [], []]
    return {**dict(zip(("times", "joints", "rail", "vehicle"), columns, strict=True)), "steps": steps}


def _note_step(steps: list[dict[str, object]], event: Mapping[str, object], now: float) -> None:
    """Add the step that this event begins; or the end, in s, of the newest one."""
    if event["kind"] == "step_started":
        steps.append({"name": event["step"], "begin": now, "end": None})
    elif event["kind"] in ("step_done", "step_failed") and steps:
        steps[-1]["end"] = now


RUN = re.compile(r"\d{8}T\d{6}-[0-9a-f]{4}")
PICTURE = re.compile(r"[\w][\w.+-]*\.png")
READ = ("report.json", "journal.sqlite")
MOST_RUNS, MOST_PICTURES = 200, 60
DRAW_S = 60.0
_DRAW = "import sys; from pathlib import Path; from cell.run.report.page.make import write_page; "
_DRAW += "from cell.apps.console.host.rehearsal import end_with_parent; end_with_parent(); "
_DRAW += "write_page(Path(sys.argv[1]), Path(sys.argv[2]))"


class Archive:
    """Below the folder `root`, of a cell whose calibration, in `calibrations`, may be `max_age_s` old. What is not
    there is None."""

    def __init__(self, root: Path, calibrations: Path, max_age_s: float) -> None:
        self._root, self._calibrated = root, (str(calibrations), str(max_age_s))
        self._rows: dict[tuple[Path, int], dict[str, Any]] = {}
        self._pages = tempfile.TemporaryDirectory(prefix="cell-console-")
        self._drawing = threading.Lock()

    def runs(self) -> list[dict[str, Any]]:
        """Newest first; see docs/reference/console.md."""
        folders = reversed(list_runs(self._root)[-MOST_RUNS:])
        return [self._row(folder) for folder in folders if self._folder(folder.name) is not None]

    def trend(self) -> list[dict[str, object]]:
        """Jobs, oldest first."""
        keys = ("run", "started", "job", "outcome", "d_mean_mm", "expected_mm", "duration_s")
        return [{key: row[key] for key in keys} for row in reversed(self.runs()) if row["kind"] == "job"]

    def health(self) -> dict[str, object] | None:
        """What `cell health` tells; found by a process of its own that gives way."""
        told = self._printed("-m", "cell.run.health", str(self._root), *self._calibrated)
        return None if told is None else dict(json.loads(told))

    def run(self, name: str) -> dict[str, object] | None:
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
        record = below(self._root, folder.name, FILE)
        replay = record is not None and moves(record)
        return {"run": folder.name, "report": report, "pictures": names[:MOST_PICTURES], "replay": replay}

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
        page = Path(self._pages.name) / f"{name}-{_written(folder)}.html"
        with self._drawing:
            if not page.exists() and self._printed("-c", _DRAW, str(folder), str(page)) is None:
                return None
            if not (folder / "report.json").exists():
                # A run that goes on is drawn anew each time.
                return page.rename(page.with_suffix(".now.html"))
        return page

    def _printed(self, *arguments: str) -> bytes | None:
        """What a process of its own, which gives way and ends with this one, prints; None when it fails."""
        command, silent = ["nice", "-n", "10", sys.executable, *arguments], subprocess.DEVNULL
        # Into a file: the pipe to it stays open, whose end tells the process that this one is gone.
        with tempfile.TemporaryFile() as printed:
            try:
                with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=printed, stderr=silent) as process:
                    try:
                        done = process.wait(DRAW_S) == 0
                    finally:
                        process.kill()
            except (OSError, subprocess.TimeoutExpired):
                return None
            printed.seek(0)
            return printed.read() if done else None

    def replay(self, name: str) -> dict[str, object] | None:
        """How the cell moved in a run; None for one whose record does not tell. A record has tens of megabytes: it is
        read by a process of its own that gives way, and what it told is kept."""
        folder = self._folder(name)
        if folder is None or below(self._root, folder.name, FILE) is None:
            return None
        kept = Path(self._pages.name) / f"{name}.json"
        with self._drawing:
            if not kept.exists():
                read = self._printed("-m", "cell.apps.console.view.archive", str(folder / FILE))
                if read is None:
                    return None
                # A run that goes on is read anew each time.
                kept = kept if (folder / "report.json").exists() else kept.with_suffix(".now.json")
                kept.write_bytes(read)
            motion: dict[str, Any] = json.loads(kept.read_bytes())
        return {"run": name, **motion} if motion["times"] else None

    def _folder(self, name: str) -> Path | None:
        """The folder of a run; none that is a link, or whose report or journal is no file of its own."""
        folder = self._root / name
        if not RUN.fullmatch(name) or folder.is_symlink() or not folder.is_dir():
            return None
        read = [folder / file for file in READ if (folder / file).is_symlink() or (folder / file).exists()]
        return folder if all(below(self._root, name, path.name) for path in read) else None

    def _row(self, folder: Path) -> dict[str, Any]:
        if (known := self._rows.get((folder, written := _written(folder)))) is not None:
            return known
        row = run_row(folder)
        try:
            report = read_report(folder)
        except (CellError, OSError):
            report = {}
        row |= {"d_mean_mm": true_error_mm(report), "expected_mm": _stated(report)}
        if written:
            self._rows[folder, written] = row
        return row


def _written(folder: Path) -> int:
    """When a run's report was last written, ns, 0 for never: at first it lacks what takes long to reckon."""
    report = folder / "report.json"
    return report.stat().st_mtime_ns if report.exists() else 0


def true_error_mm(report: Mapping[str, Any]) -> float | None:
    """The true place error of a simulated run, mean of the part's points, mm; None where nobody knows it."""
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


if __name__ == "__main__":
    end_with_parent()
    print(json.dumps(motion(Path(sys.argv[1]))))
