"""A world as a row: flat, with units in the names of its columns, the same bit for bit wherever it was run.

A world whose job has several items is one row: it is as good as its worst item, and each figure is the one nearest its
limit.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from cell.apps.qualify.identity import QualifiedCode
from cell.run.batch import GOOD
from cell.run.folder import Report
from drivers.errors import MeasuredRow

Value = str | int | float | bool | None
Row = dict[str, Value]
"""A row by the names of its columns; what is not known of a world is missing, or None."""
BOUNDS = {"at most": " at most", "at least": " at least"}
"""What a figure is held against, and how the column of its limit ends, after the figure's own name."""
NOT_COMPARED = ("wall_s", "ended_s")
"""Columns that are others each time: seconds on the wall, and when the world ended, in seconds since 1970."""
TEXTS = ("key", "job", "job_hash", "configuration_hash", "code_hash", "level", "schedule", "outcome", "step", "code")
WHOLE = ("seed", "parts", "corrections", "retries", "faults")
WORST_FIRST = ("error", "aborted", "faulted", "misplaced", "refused")


def row_of(of: QualifiedCode, level: str, seed: int, reports: Sequence[Report], covered: float | None = None) -> Row:
    """The row of a world whose runs left these `reports`, one for each item that was tried.

    `covered` is the share of the part's points that ended within the stated bound.
    """
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
    """The share of its limit that a value of this column uses, 1 at the limit; `end` is that of the limit's column.

    A share in % that has to be large is as good as can be at 100.
    """
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


def compared(row: Mapping[str, object]) -> dict[str, object]:
    """Those columns of a row that are the same each time; what is not known is left out."""
    return {name: value for name, value in row.items() if name not in NOT_COMPARED and value is not None}


def number(value: Value) -> float:
    """A value as a number; 0 where it is none."""
    return float(value) if isinstance(value, int | float) else 0.0
