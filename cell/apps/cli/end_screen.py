"""The end of a run on one screen, 80 columns by 24 lines with the prompt: how it ended, its steps, what was measured
beside its limit, what went wrong on the way, where the report is, and what to type next."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cell.run.files.reading import wall_seconds
from cell.run.report.figures import following_words, shown_limit, shown_value, simulated_words

WIDTH, HEIGHT = 80, 23
"""What a screen holds; its last line is left to the prompt."""
REASON_LINES = 3
LABEL = 10
"""Columns of the words at the left edge."""


def end_screen(report: Mapping[str, Any], folder: Path, width: int = WIDTH) -> list[str]:
    """The lines for a report, at most `HEIGHT` of at most `width` columns; a longer path or command goes on below."""
    width = max(width, 60)
    outcome = str(report["outcome"])
    head = _cut_lines(f"{outcome}  {report.get('reason', '')}", width, REASON_LINES)
    head.append(_cut(_facts(report), width))
    steps = _steps(report)
    followed = report.get("following")
    late = _labelled("followed", following_words(followed), width) if followed else []
    tail = [*_trouble(report, width), *late, *_labelled("report", _shown_path(folder), width)]
    if (advice := next_step(report, folder)) is not None:
        tail += _labelled("next", advice, width)
    blanks = 2 if report.get("measured") else 1
    room = HEIGHT - len(head) - len(steps) - len(tail) - blanks
    measured = [_cut(_figure(row), width) for row in (report.get("measured") or ())[: max(0, room)]]
    return [*head, *steps, *([""] * bool(measured)), *measured, "", *tail]


def next_step(report: Mapping[str, Any], folder: Path) -> str | None:
    """What a person would type after a run that ended so; None where there is nothing to add."""
    outcome, kind, name = report["outcome"], report.get("kind", "job"), folder.name.split("-")[-1]
    again = "cell dry-run" if report.get("simulated") is True else "cell run"
    if job := report.get("for_job"):
        return f"cell diag: the state of every device; put that right, then {again} -j {_job({'job_file': job})}"
    if kind != "job":
        if outcome == "done":
            return "cell calibrate verify: how good it is" if kind == "calibration" else None
        return "cell diag: the state of every device"
    part = None if outcome in ("placed", "done") else report.get("part")
    if part == "released":
        return f"look at the part, it is down; cell home: fold the arm; then {again} -j {_job(report)}: the next part"
    if part == "unknown":
        return f"look what has become of the part; cell home: fold the arm; then {again} -j {_job(report)}"
    match outcome:
        case "done":
            return f"cell report {name}: what was measured; nothing was placed"
        case "placed":
            return f"cell report {name} --html: all of it as a page; cell export: the cloud"
        case "refused" if report.get("code") == "CalibrationStale":
            return f"cell calibrate, then {again} -j {_job(report)}"
        case "refused":
            return f"picture.png shows why; put that right, then {again} -j {_job(report)}"
        case "faulted":
            see = "" if report.get("simulated") is True else "cell diag: the state of every device; "
            return f"{see}cell resume {name}: go on with the job"
        case "aborted":
            return f"cell resume {name}: go on with the job"
    return f"cell abort {name}, if it is still going on; cell resume {name}, if its process died"


def _job(report: Mapping[str, Any]) -> str:
    """The job as one would name it: the shipped ones by their names, others by their files."""
    from cell.config.job import job_path, shipped_jobs

    path = Path(str(report.get("job_file", report.get("job"))))
    if path.suffix == ".toml" and path.stem in shipped_jobs() and path == job_path(path.stem):
        return path.stem
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def duration(seconds: float | None) -> str:
    """A duration for people."""
    if seconds is None:
        return ""
    if seconds < 99.5:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


def _facts(report: Mapping[str, Any]) -> str:
    kind = str(report.get("kind", "job"))
    facts = [f"job {report.get('job')}" if kind == "job" else kind]
    if words := simulated_words(report.get("simulated")):
        facts.append(f"{words}, seed {report.get('seed')}, level {report.get('level')}")
    if report.get("cell_s") is None and (wall := wall_seconds(report)) is not None:
        facts.append(f"{duration(wall)} on the wall")
    if report.get("started"):
        facts.append(str(report["started"])[:16].replace("T", " "))
    return " · ".join(facts)


def _steps(report: Mapping[str, Any]) -> list[str]:
    rows = report.get("steps") or ()
    if not rows:
        return []
    lines = [f"{'step':<18}{'state':<10}{'cell time':>11}{'wall time':>12}{'retries':>9}"]
    for row in rows:
        begun = row.get("state") != "open"
        cell, wall = (_seconds(row.get(key)) if begun else "" for key in ("duration_s", "wall_s"))
        retries = str(row.get("retries", "")) if begun else ""
        lines.append(f"{row['name']!s:<18}{row['state']!s:<10}{cell:>11}{wall:>12}{retries:>9}")
    if report.get("cell_s") is not None:
        lines.append(f"{'whole run':<28}{_seconds(report['cell_s']):>11}{_seconds(wall_seconds(report)):>12}")
    return lines


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.2f} s"


def _figure(row: Mapping[str, Any]) -> str:
    mark = "  " if row.get("kept", True) else "! "
    name = textwrap.shorten(str(row.get("name")), 46, placeholder=" …")
    return f"{mark}{name:<46} {shown_value(row):>11}  {shown_limit(row)}".rstrip()


def _trouble(report: Mapping[str, Any], width: int) -> list[str]:
    """Faults and retries, a line each; nothing for a report that does not tell."""
    if "faults" not in report:
        return []
    faults, retried = report["faults"], [row for row in report.get("steps") or () if row.get("retries")]
    if not faults and not retried:
        return [f"{'faults':<{LABEL}}none, and no retries"]
    told = "; ".join(f"{fault.get('code')} in {fault.get('step')}, {fault.get('remedy')}" for fault in faults)
    lines = [_cut(f"{'faults':<{LABEL}}{len(faults)}: {told}" if faults else f"{'faults':<{LABEL}}none", width)]
    again = ", ".join(f"{row['name']} {row['retries']}" for row in retried) or "none"
    return [*lines, _cut(f"{'retries':<{LABEL}}{again}", width)]


def _labelled(label: str, text: str, width: int) -> list[str]:
    lines = textwrap.wrap(text, width - LABEL, break_on_hyphens=False)
    return [f"{label if k == 0 else '':<{LABEL}}{line}" for k, line in enumerate(lines)]


def _shown_path(folder: Path) -> str:
    """The report's path, from the present folder if it lies below."""
    here = Path.cwd()
    folder = folder.resolve()
    return f"{folder.relative_to(here) if folder.is_relative_to(here) else folder}/report.json"


def _cut_lines(text: str, width: int, most: int) -> list[str]:
    lines = textwrap.wrap(text, width, break_on_hyphens=False)
    if len(lines) <= most:
        return lines
    # What to do about it stands at the end, and is not what is left out.
    remedy = textwrap.wrap(text.rpartition(". ")[2], width, break_on_hyphens=False)
    if not 0 < len(remedy) < most or ". " not in text:
        return [*lines[: most - 1], _cut(" ".join(lines[most - 1 :]), width)]
    head = most - len(remedy)
    return [*lines[: head - 1], _cut(" ".join(lines[head - 1 :]), width), *remedy]


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else text[: width - 2].rstrip() + " …"
