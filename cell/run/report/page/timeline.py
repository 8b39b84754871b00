"""Steps and faults of a run along its time, as an inline SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from html import escape
from pathlib import Path
from typing import Any

from statemachine.journal import JournalError, JournalRecord, read

WIDTH, ROW, LEFT, RIGHT = 900, 24, 150, 20
"""In px of the drawing; `LEFT` is the room of the steps' names."""
SHOWN = ("confirm_needed", "confirmed", "paused", "going_on", "safe_stop")
"""Events of the journal that are marked, beside the faults."""
COLOURS = {"done": "#4d8f4d", "failed": "#c0392b", "running": "#888888"}
TICKS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200)


@dataclass(frozen=True)
class Bar:
    """An attempt at a step, from its begin to its end in seconds of the run."""

    step: str
    attempt: int
    begin: float
    end: float
    state: str


@dataclass(frozen=True)
class TimelineMark:
    """Something that happened, in seconds of the run; `bad` for a fault."""

    at: float
    text: str
    bad: bool


@dataclass(frozen=True)
class Timeline:
    """What is drawn, and which time it is told in."""

    bars: tuple[Bar, ...]
    marks: tuple[TimelineMark, ...]
    length: float
    clock: str


def timeline(folder: Path, report: Mapping[str, Any]) -> Timeline | None:
    """The course of a run by its journal; None where that tells no step.

    On the virtual clock the wall's time says nothing: the attempts' durations in the cell's time are laid end to end,
    and what the report calls a fault stands at the end of its attempt.
    """
    try:
        record = read(folder)
    except (JournalError, ValueError, TypeError):
        return None
    if not record.steps:
        return None
    return _virtual(record, report) if report.get("clock") == "virtual" else _wall(record, report)


def _wall(record: JournalRecord, report: Mapping[str, Any]) -> Timeline:
    start = record.run.started
    last = max(
        [record.run.ended or start, *(step.ended or step.started for step in record.steps)]
        + [event.at for event in record.events]
    )
    bars = [Bar(s.name, s.attempt, s.started - start, (s.ended or last) - start, s.state) for s in record.steps]
    marks = [TimelineMark(e.at - start, _told(e.kind, e.data), False) for e in record.events if e.kind in SHOWN]
    for fault in report.get("faults") or ():
        at = datetime.fromisoformat(str(fault["at"])).timestamp() - start
        marks.append(TimelineMark(min(max(at, 0.0), last - start), _fault(fault), True))
    return Timeline(tuple(bars), tuple(marks), max(last - start, 0.1), "on the wall")


def _virtual(record: JournalRecord, report: Mapping[str, Any]) -> Timeline:
    bars, now = [], 0.0
    for step in record.steps:
        length = step.duration_s or 0.0
        bars.append(Bar(step.name, step.attempt, now, now + length, step.state))
        now += length
    ends = {(bar.step, bar.attempt): bar.end for bar in bars}
    marks = [
        TimelineMark(ends.get((fault["step"], fault["attempt"]), now), _fault(fault), True)
        for fault in report.get("faults") or ()
    ]
    return Timeline(tuple(bars), tuple(marks), max(now, 0.1), "of the cell's clock")


def _told(kind: str, data: Mapping[str, Any]) -> str:
    what = data.get("reason") or data.get("text") or data.get("by") or ""
    return f"{kind.replace('_', ' ')}: {what}" if what else kind.replace("_", " ")


def _fault(fault: Mapping[str, Any]) -> str:
    return f"{fault.get('code')} in {fault.get('step')}: {fault.get('reason')} ({fault.get('remedy')})"


def timeline_svg(course: Timeline) -> str:
    """The drawing: a row for each step, a number for each mark; `mark_rows` tells what they are."""
    names = list(dict.fromkeys(bar.step for bar in course.bars))
    height = ROW * (len(names) + 1) + 34
    scale = (WIDTH - LEFT - RIGHT) / course.length
    parts = [f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="steps along the time">']
    tick = next((tick for tick in TICKS if course.length / tick <= 10), course.length / 8)
    for k in range(int(course.length / tick) + 1):
        x = LEFT + scale * k * tick
        parts.append(f'<line x1="{x:.1f}" y1="{ROW}" x2="{x:.1f}" y2="{height - 30}" stroke="#ddd"/>')
        parts.append(f'<text x="{x:.1f}" y="{height - 16}" text-anchor="middle">{k * tick:g}</text>')
    parts.append(f'<text x="{WIDTH - RIGHT}" y="{height - 2}" text-anchor="end">s {escape(course.clock)}</text>')
    for row, name in enumerate(names):
        y = ROW * (row + 1)
        parts.append(f'<text x="{LEFT - 8}" y="{y + 16}" text-anchor="end">{escape(name)}</text>')
        for bar in (bar for bar in course.bars if bar.step == name):
            wide = max(2.0, scale * (bar.end - bar.begin))
            told = f"{name}, attempt {bar.attempt}: {bar.state}, {bar.end - bar.begin:.2f} s"
            parts.append(
                f'<rect x="{LEFT + scale * bar.begin:.1f}" y="{y + 4}" width="{wide:.1f}" height="{ROW - 8}" '
                f'fill="{COLOURS.get(bar.state, "#888888")}"><title>{escape(told)}</title></rect>'
            )
    for number, mark in enumerate(course.marks, 1):
        x, colour = LEFT + scale * mark.at, "#c0392b" if mark.bad else "#2c5f9e"
        parts.append(
            f'<line x1="{x:.1f}" y1="{ROW - 4}" x2="{x:.1f}" y2="{height - 30}" stroke="{colour}" '
            f'stroke-dasharray="3 3"/><text x="{x:.1f}" y="{ROW - 8}" text-anchor="middle" fill="{colour}">'
            f"{number}<title>{escape(mark.text)}</title></text>"
        )
    return "".join([*parts, "</svg>"])


def mark_rows(marks: Sequence[TimelineMark]) -> list[tuple[str, str, str]]:
    """Number, time and words of each mark."""
    return [(str(number), f"{mark.at:.2f} s", mark.text) for number, mark in enumerate(marks, 1)]
