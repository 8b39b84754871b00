"""The page of a run: one HTML file that asks nobody for anything, for a browser and for paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2

from cell.run.folder import read_report
from cell.run.report.figures import noise_rows, simulated_words
from cell.run.report.page import facts, render
from cell.run.report.page.course import Timeline, Trend, past_runs, timeline
from cell.run.report.page.facts import RunVerdict, TableRow
from cell.run.report.page.surface import SurfaceView, surface_view
from drivers.errors import CellError

MOST_BYTES = 3_000_000
"""Size of a page; photographs that would make it larger are left out, and that is said."""
MOST_EDGE = 900
"""Longer edge of a picture in px; a larger one is made smaller."""
QUALITY = 82
MOST_LAST = 6


@dataclass(frozen=True)
class Photograph:
    """A picture as JPEG and what it shows; a `wide` one takes both columns."""

    caption: str
    jpeg: bytes
    wide: bool


@dataclass(frozen=True, eq=False)
class RunPage:
    """What `run.html.jinja` shows; what is empty or None is left out.

    `refused` is where, of a refused run; `unreadable` why the cloud is not shown; `left_out` counts photographs.
    """

    run: str
    what: str
    outcome: str
    simulated: str
    world: str
    verdict: RunVerdict
    reason: str
    refused: str
    judged: Sequence[TableRow]
    compared: Sequence[TableRow]
    surface: SurfaceView | None
    unreadable: str
    course: Timeline | None
    trend: Trend | None
    used: Sequence[TableRow]
    noise: Sequence[TableRow]
    noise_level: str
    photographs: Sequence[Photograph] = ()
    left_out: int = 0


def make_page(folder: Path) -> str:
    """The page of the run in `folder`, at most `MOST_BYTES` long in UTF-8.

    Raises `CellError` or `ConfigError` where the folder holds no run that can be read.
    """
    report = read_report(folder)
    try:
        page = _run_page(folder, report)
    except (KeyError, TypeError, ValueError) as error:
        raise CellError(
            f"the report of run {folder.name} is not as this version writes it ({type(error).__name__}: {error}); "
            "`cell report --json` shows what it holds"
        ) from error
    return _html(_with_photographs(page, folder, report, MOST_BYTES - len(_html(page).encode()) - 1000))


def write_page(folder: Path, out: Path) -> int:
    """Write the page of the run in `folder` to `out`; its size in bytes. `CellError` where it cannot be written."""
    data = make_page(folder).encode("utf-8")
    try:
        out.write_bytes(data)
    except OSError as error:
        raise CellError(f"{out} cannot be written: {error.strerror}; name another file with --out") from error
    return len(data)


def _html(page: RunPage) -> str:
    return render(__package__, "run.html.jinja", page=page)


def _run_page(folder: Path, report: Mapping[str, Any]) -> RunPage:
    """All but the photographs. Raises `KeyError`, `TypeError` or `ValueError` for a report of another form."""
    kind, refusal, noise = str(report.get("kind", "job")), report.get("refusal"), report.get("assumed_noise") or {}
    tolerance = (report.get("tolerance") or {}).get("translation_mm")
    refused = "" if not refusal else f"in the step {refusal['step']}" if refusal.get("step") else "between two steps"
    surface, unreadable = None, ""
    try:
        surface = surface_view(folder, report)
    except CellError as error:
        unreadable = str(error)
    return RunPage(
        run=str(report["run"]),
        what=f"Job {report.get('job')}" if kind == "job" else kind.capitalize(),
        outcome=str(report["outcome"]),
        simulated=simulated_words(report.get("simulated")),
        world=f"seed {report.get('seed')}, level {report.get('level')}",
        verdict=facts.verdict(report),
        reason=str(report.get("reason") or ""),
        refused=refused,
        judged=facts.judged(report),
        compared=facts.compared(report),
        surface=surface,
        unreadable=unreadable,
        course=timeline(folder, report),
        trend=Trend(past_runs(folder, report), tolerance) if kind == "job" else None,
        used=facts.identities(folder, report),
        noise=[TableRow(row) for row in noise_rows(noise)],
        noise_level=str(noise.get("level") or ""),
    )


def _with_photographs(page: RunPage, folder: Path, report: Mapping[str, Any], room: int) -> RunPage:
    """The page with the photographs that need no more than `room` bytes."""
    shown, left_out = [], 0
    for path, caption in chosen(folder, report):
        if (made := photograph(path, caption)) is None:
            continue
        # Base64 makes four bytes of three; the caption stands there twice, escaped.
        size = 4 * len(made.jpeg) // 3 + 12 * len(made.caption) + 200
        if size > room:
            left_out += 1
            continue
        room -= size
        shown.append(made)
    return replace(page, photographs=shown, left_out=left_out)


def chosen(folder: Path, report: Mapping[str, Any]) -> list[tuple[Path, str]]:
    """Files and captions, the most telling first: what a run looked at that did not place, or what it measured with."""
    last = [str(name) for name in report.get("last_frames") or ()][-MOST_LAST:]
    if report.get("outcome") not in ("placed", "done"):
        seen = [(folder / name, "looked at last, before the run ended") for name in reversed(last)]
        drawn = [(folder / "picture.png", "what was found in the pictures, and why the run ended")]
        found = [(path, caption) for path, caption in [*drawn, *seen] if path.is_file()]
        return found if last else [*found, *_measured_with(folder / "frames")]
    return _measured_with(folder / "frames")


def _measured_with(frames: Path) -> list[tuple[Path, str]]:
    boards = sorted(frames.glob("board-*.png"))
    stripes = sorted(frames.glob("stripe-*.png"))
    picked = [(path, "the board, photographed last") for path in boards[-1:]]
    numbers = dict.fromkeys(len(stripes) * k // 4 for k in (2, 1, 3)) if stripes else {}
    return picked + [(stripes[k], f"the sweep, frame {k + 1} of {len(stripes)}") for k in numbers]


def photograph(path: Path, caption: str) -> Photograph | None:
    """The picture in `path`, at most `MOST_EDGE` px long; None for a file that is no picture (any more)."""
    drawn = path.name == "picture.png"
    image = cv2.imread(str(path), cv2.IMREAD_COLOR if drawn else cv2.IMREAD_GRAYSCALE)
    if image is None:
        return None
    # The drawn picture has small letters: it keeps its size.
    share = 1.0 if drawn else MOST_EDGE / max(image.shape[:2])
    if share < 1.0:
        image = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    return Photograph(f"{path.name}: {caption}", data.tobytes(), drawn) if done else None
