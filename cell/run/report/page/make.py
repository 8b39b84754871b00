"""The page of a run: one HTML file that asks nobody for anything, for a browser and for paper."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from cell.run.folder import read_report
from cell.run.report.figures import noise_rows, simulated_words
from cell.run.report.page import facts
from cell.run.report.page.maps import map_picture, view_data
from cell.run.report.page.photographs import chosen, photograph
from cell.run.report.page.scanned import scanned
from cell.run.report.page.timeline import mark_rows, timeline, timeline_svg
from cell.run.report.page.trend import past_runs, trend_svg
from cell.run.report.pictures import SCALE_SHARE
from drivers.errors import CellError

MOST_BYTES = 3_000_000
"""Size of a page; photographs that would make it larger are left out, and that is said."""
SPAN_MM = 0.2
"""End of the scale of deviations where a report names no tolerance."""
FIGURES = ("figure", "value", "limit")
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
"""What a browser lets this page do: nothing that leaves the file."""


def make_page(folder: Path) -> str:
    """The page of the run in `folder`, at most `MOST_BYTES` long in UTF-8.

    Raises `CellError` or `ConfigError` where the folder holds no run that can be read.
    """
    report = read_report(folder)
    try:
        before = [_head(report), _verdict(report), _judged(report), _compared(report), *_surface(folder, report)]
        after = [_course(folder, report), _trend(folder, report), _identities(folder, report), _noise(report)]
    except (KeyError, TypeError, ValueError) as error:
        raise CellError(
            f"the report of run {folder.name} is not as this version writes it ({type(error).__name__}: {error}); "
            "`cell report --json` shows what it holds"
        ) from error
    room = MOST_BYTES - sum(len(part.encode()) for part in (*before, *after)) - 10_000
    return "\n".join([*before, _photographs(folder, report, room), *after, "</body></html>\n"])


def write_page(folder: Path, out: Path) -> int:
    """Write the page of the run in `folder` to `out`; its size in bytes. `CellError` where it cannot be written."""
    data = make_page(folder).encode("utf-8")
    try:
        out.write_bytes(data)
    except OSError as error:
        raise CellError(f"{out} cannot be written: {error.strerror}; name another file with --out") from error
    return len(data)


def _head(report: Any) -> str:
    title = f"{report['outcome']}: run {report['run']}"
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_resource('page.css')}</style></head><body>"
    )


def _resource(name: str) -> str:
    return files("cell.run.report.page").joinpath(name).read_text(encoding="utf-8")


def _verdict(report: Any) -> str:
    kind = str(report.get("kind", "job"))
    what = f"Job {report.get('job')}" if kind == "job" else kind.capitalize()
    words, good = facts.verdict(report)
    outcome, _, others = words.partition("; ")
    parts = [f"<h1>{escape(what)}, run {escape(str(report['run']))}</h1>"]
    if simulated := simulated_words(report.get("simulated")):
        seed = f"seed {report.get('seed')}, level {report.get('level')}"
        parts.append(f'<p class="simulated"><b>{escape(simulated.capitalize())}</b>: {escape(seed)}</p>')
    parts.append(
        f'<div class="verdict{" good" if good else ""}"><strong>{escape(outcome)}</strong> {escape(others)}'
        f'<p class="reason">{escape(str(report.get("reason") or ""))}</p></div>'
    )
    return "".join(parts)


def _judged(report: Any) -> str:
    rows = facts.judged(report)
    refusal = report.get("refusal")
    if not refusal:
        return _section("What was measured, beside its limit", _table(FIGURES, rows, "numbers"), rows)
    where = f"in the step {refusal['step']}" if refusal.get("step") else "between two steps"
    body = _table(FIGURES, rows, "numbers") if rows else "<p>It rests on no figure; the reason stands above.</p>"
    return _section(f"Refused {where}: what was measured, beside its limit", body)


def _compared(report: Any) -> str:
    rows = [(row, True) for row in facts.compared(report)]
    note = (
        "The surface may lie anywhere: the part goes where it was found, so its deviation from where the board and the "
        "drawing put it has no tolerance (axes of the arm base, about the surface's origin). The part's 45 points are "
        "compared along the axes of the surface; what they did is known in a simulated world only."
    )
    return _section("Nominal and actual", f'{_table(facts.COMPARED, rows, "numbers")}<p class="note">{note}</p>', rows)


def _surface(folder: Path, report: Any) -> list[str]:
    try:
        scan = scanned(folder, report)
    except CellError as error:
        return [_section("The scanned surface", f"<p>{escape(str(error))}</p>")]
    if scan is None or not len(scan.points):
        return []
    tolerance = (report.get("tolerance") or {}).get("translation_mm")
    span = SPAN_MM if tolerance is None else SCALE_SHARE * float(tolerance)
    about = f"Fixed scale, ± {span:.3g} mm." if scan.deviation is not None else f"Shown by height: {scan.why}."
    picture = _image("image/png", map_picture(scan, span), "map of the surface and histogram")
    data = view_data(scan, span)
    thinned = f"{data['count']} of {data['total']} measured points"
    colours = base64.b64decode(data["palette"])
    stops = ",".join(f"rgb({colours[3 * k]},{colours[3 * k + 1]},{colours[3 * k + 2]})" for k in range(0, 255, 15))
    beside = "; grey ones do not lie over the drawn surface" if scan.deviation is not None else ""
    unit = "deviation" if scan.deviation is not None else "height"
    sign = "+" if scan.deviation is not None else ""
    return [
        _section("The scanned surface", f'{picture}<p class="note">{escape(about)}</p>'),
        _section(
            "The cloud",
            f'<canvas id="cloud" width="1800" height="1000" tabindex="0" role="img" aria-label="the cloud in 3-D">'
            "</canvas>"
            f'<div class="scale"><span>{data["from"]:.3g} mm</span><div style="background:linear-gradient(to right,'
            f'{stops})"></div><span>{data["to"]:{sign}.3g} mm ({unit})</span></div>'
            '<p class="screen"><button id="view-start">askew</button> <button id="view-above">from above</button> '
            '<button id="view-side">from the side</button> drag to turn, wheel or + − to zoom, arrow keys</p>'
            f'<p class="note">{thinned} are shown{beside}.</p>'
            f'<script type="application/json" id="cloud-data">{json.dumps(data)}</script>'
            f"<script>{_resource('cloud.js')}</script>",
        ),
    ]


def _photographs(folder: Path, report: Any, room: int) -> str:
    figures, left_out = [], 0
    for path, caption in chosen(folder, report):
        if (made := photograph(path, caption)) is None:
            continue
        wide = ' class="wide"' if path.name == "picture.png" else ""
        figure = (
            f"<figure{wide}>{_image('image/jpeg', made.jpeg, made.caption)}"
            f"<figcaption>{escape(made.caption)}</figcaption></figure>"
        )
        if len(figure) > room:
            left_out += 1
            continue
        room -= len(figure)
        figures.append(figure)
    said = f'<p class="note">{left_out} more did not fit; they lie in the run\'s folder.</p>' if left_out else ""
    return _section("Photographs", f'<div class="photographs">{"".join(figures)}</div>{said}', figures, long=True)


def _course(folder: Path, report: Any) -> str:
    if (course := timeline(folder, report)) is None:
        return ""
    rows = [(row, True) for row in mark_rows(course.marks)]
    marks = (
        _table(("", "at", "what happened"), rows, "marks") if rows else '<p class="note">No fault, and no retry.</p>'
    )
    return _section("Steps and faults", f"{timeline_svg(course)}{marks}", long=bool(rows))


def _trend(folder: Path, report: Any) -> str:
    if report.get("kind", "job") != "job":
        return ""
    runs = past_runs(folder, report)
    tolerance = (report.get("tolerance") or {}).get("translation_mm")
    note = (
        f"{len(runs)} run{'s' * (len(runs) > 1)} of this job, this one at the right. Filled: largest true error of the "
        "part's points (simulated worlds only); rings: stated 95 % bound; ✕: no place was found."
    )
    return _section("Runs of this job", f'{trend_svg(runs, tolerance)}<p class="note">{note}</p>')


def _identities(folder: Path, report: Any) -> str:
    rows = [(row, True) for row in facts.identities(folder, report)]
    return _section("What was used", _table(("", ""), rows), long=True)


def _noise(report: Any) -> str:
    rows = [(row, True) for row in noise_rows(report.get("assumed_noise") or {})]
    level = (report.get("assumed_noise") or {}).get("level")
    title = "Assumed noise" + (f", level {level}" if level else "")
    return _section(title, _table(("of", "one standard deviation", "unit"), rows, "numbers"), rows, long=True)


def _table(head: Sequence[str], rows: Iterable[tuple[Sequence[str], bool]], look: str = "") -> str:
    """An HTML table, every word escaped; a row that is not good is marked."""
    top = "".join(f"<th>{escape(name)}</th>" for name in head)
    lines = "".join(
        f"<tr{'' if good else ' class=outside'}>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>"
        for row, good in rows
    )
    header = f"<thead><tr>{top}</tr></thead>" if any(head) else ""
    return f'<table class="{look}">{header}<tbody>{lines}</tbody></table>'


def _section(title: str, body: str, needed: object = True, *, long: bool = False) -> str:
    """A section of the page; nothing where what it `needed` is not there. A `long` one may be broken between pages."""
    if not needed:
        return ""
    return f"<section{' class=long' if long else ''}><h2>{escape(title)}</h2>{body}</section>"


def _image(kind: str, data: bytes, words: str) -> str:
    return f'<img alt="{escape(words)}" src="data:{kind};base64,{base64.b64encode(data).decode("ascii")}">'
