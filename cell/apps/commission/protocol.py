"""The protocol of a commissioning: one page that can be printed, with every figure, its limit, and the pictures."""

from __future__ import annotations

import base64
import time
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from cell.apps.commission.check import CommissionCheck, Progress, bounds
from cell.base.version import release
from cell.config.cell_config import CellConfig
from drivers.interfaces import Reading

FILE = "protocol.html"
_STYLE = """
body { font: 11pt/1.4 sans-serif; margin: 2em auto; max-width: 60em; color: #111 }
table { border-collapse: collapse; margin: .5em 0 1em; width: 100% }
th, td { border: 1px solid #bbb; padding: .2em .5em; text-align: left; vertical-align: top }
td.n { text-align: right; font-variant-numeric: tabular-nums }
.good { color: #060 } .wrong, .failed, .declined, .stale, .open { color: #a00 }
section { break-inside: avoid-page; border-top: 1px solid #bbb; margin-top: 1em }
img { max-width: 19em; margin: 0 .5em .5em 0; border: 1px solid #bbb }
figure { display: inline-block; margin: 0 } figcaption { font-size: 9pt }
"""


def write_protocol(progress: Progress, checks: Sequence[CommissionCheck], config: CellConfig) -> Path:
    """Write the page beside the record of the progress; returns its path."""
    parts = [*_head(progress, checks, config), *_mended(progress.mended)]
    for check in checks:
        parts += _check(progress, check, progress.standing(check, config))
    parts.append("<p>Date, name, signature: ______________________________________</p>")
    text = (
        "<!doctype html><html lang='en'><meta charset='utf-8'>"
        f"<title>Commissioning of {escape(config.cell.name)}</title>"
        f"<style>{_STYLE}</style><body>{''.join(parts)}</body></html>\n"
    )
    path = progress.folder / FILE
    path.write_text(text, encoding="utf-8")
    return path


def _head(progress: Progress, checks: Sequence[CommissionCheck], config: CellConfig) -> Iterable[str]:
    yield f"<h1>Commissioning of {escape(config.cell.name)}</h1>"
    cell = progress.cell
    if cell.get("simulated"):
        yield f"<p class='wrong'>A simulated cell: {escape(_said(cell))}. Nothing here is of hardware.</p>"
    yield f"<p>Written {time.strftime('%Y-%m-%d %H:%M:%S')} by cell {escape(release())}.</p>"
    rows = []
    for number, check in enumerate(checks, 1):
        standing = progress.standing(check, config)
        when = (progress.result(check.name) or {}).get("when", "")
        rows.append(
            f"<tr><td class='n'>{number}</td><td><a href='#{check.name}'>{escape(check.title)}</a></td>"
            f"<td class='{standing}'>{standing}</td><td>{escape(when)}</td></tr>"
        )
    yield f"<table><tr><th></th><th>check</th><th>verdict</th><th>done</th></tr>{''.join(rows)}</table>"


def _said(cell: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in cell.items() if name != "simulated" and value is not None)


def _mended(mended: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    if not mended:
        return
    yield "<h2>Found and mended</h2>"
    rows = [
        f"<tr><td>{escape(entry['name'])}</td><td>{escape(entry['what'])}</td><td>{escape(entry['told'])}</td>"
        f"<td>{escape(entry['found'])}</td>"
        f"<td>{escape('; '.join(f'{k} = {v}' for k, v in entry['write'].items()))}</td>"
        f"<td>{escape(entry['check'])}, {escape(entry['when'])}; before: {escape(entry['backup'])}</td></tr>"
        for entry in mended
    ]
    head = "".join(f"<th>{name}</th>" for name in ("name", "what", "configured", "measured", "written", "when"))
    yield f"<table><tr>{head}</tr>{''.join(rows)}</table>"


def _check(progress: Progress, check: CommissionCheck, standing: str) -> Iterable[str]:
    yield f"<section id='{check.name}'><h2>{escape(check.title)}</h2>"
    moves = "nothing" if check.moves == "nothing" else f"{check.moves}; {check.far}; {check.fast}"
    yield f"<p><b>Moves:</b> {escape(moves)}.<br><b>Limit:</b> {escape(check.limit)}.</p>"
    result = progress.result(check.name)
    if result is None:
        yield "<p class='open'>not done</p></section>"
        return
    run = f", run {result['run']}" if result["run"] else ""
    yield f"<p class='{standing}'><b>{standing}</b> ({escape(result['when'])}, {result['seconds']} s{escape(run)})</p>"
    if result["readings"]:
        head = "".join(f"<th>{name}</th>" for name in ("measured", "value", "unit", "allowed", ""))
        yield f"<table><tr>{head}</tr>{''.join(_row(row) for row in result['readings'])}</table>"
    for finding in result["findings"]:
        told = f"configured {finding['told']}, measured {finding['found']}"
        said = escape(f"{finding['what']}; {told}. {finding['remedy']}")
        yield f"<p class='wrong'><b>{escape(finding['name'])}</b>: {said}</p>"
    for note in result["notes"]:
        yield f"<p>{escape(note)}</p>"
    for picture in result["pictures"]:
        path = progress.folder / picture
        if path.is_file():
            data = base64.b64encode(path.read_bytes()).decode()
            image = f"<img src='data:image/png;base64,{data}' alt=''>"
            yield f"<figure>{image}<figcaption>{escape(path.stem)}</figcaption></figure>"
    yield "</section>"


def _row(row: Mapping[str, Any]) -> str:
    reading = Reading(row["what"], row["value"], row["unit"], row["least"], row["most"])
    allowed = bounds(reading)
    mark = "" if not allowed else "<span class='good'>ok</span>" if row["ok"] else "<span class='wrong'>outside</span>"
    cells = f"<td class='n'>{row['value']:.4g}</td><td>{escape(row['unit'])}</td><td class='n'>{escape(allowed)}</td>"
    return f"<tr><td>{escape(row['what'])}</td>{cells}<td>{mark}</td></tr>"
