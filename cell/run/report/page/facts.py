"""The verdict and the tables of a page: what was used, what was judged, and nominal beside actual; all of it text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from cell.run.report.figures import shown_limit, shown_value, simulated_words

Row = tuple[str, ...]
K95 = 1.96
"""Standard deviations within which 95 % of a normal distribution lie."""
AXES = "xyz"


@dataclass(frozen=True)
class RunVerdict:
    """What a run came to in one line, beside the tolerance, and whether its outcome is a good one."""

    words: str
    good: bool


@dataclass(frozen=True)
class TableRow:
    """A row of a table; with `kept` False its figure is outside its limit."""

    cells: Row
    kept: bool = True


def verdict(report: Mapping[str, Any]) -> RunVerdict:
    """The errors beside the tolerance."""
    bound, truth = report.get("place_bound_95"), report.get("truth")
    tolerance = (report.get("tolerance") or {}).get("translation_mm")
    outside = sum(not row.kept for row in judged(report))
    words = []
    if truth is not None:
        words.append(f"true place error at most {truth['error_mm']['d']['max']:.3f} mm (simulated world)")
    if bound is not None:
        words.append(f"stated: 95 % within {bound['d']:.3f} mm")
    if tolerance is not None and (truth is not None or bound is not None):
        words.append(f"tolerance {tolerance:g} mm")
    if outside:
        words.append("one figure outside its limit" if outside == 1 else f"{outside} figures outside their limits")
    return RunVerdict("; ".join(words), report["outcome"] in ("placed", "done") and not outside)


def identities(folder: Path, report: Mapping[str, Any]) -> list[TableRow]:
    """What the run was: cell, devices, job, calibration with its age, configuration, program."""
    rows: list[Row] = [("run", str(report.get("run", folder.name))), ("cell", str(report.get("cell", "")))]
    if words := simulated_words(report.get("simulated")):
        rows.append(("world", f"{words}, seed {report.get('seed')}, level {report.get('level')}"))
    rows.append(("begun", str(report.get("started", "")).replace("T", " ")))
    rows.append(("ended", str(report.get("ended") or "not ended").replace("T", " ")))
    if report.get("kind", "job") == "job":
        rows.append(("job", f"{report.get('job')}, hash {report.get('job_hash')}"))
        if mesh := report.get("mesh"):
            name, digest = Path(str(mesh.get("file"))).name, str(mesh.get("sha256"))
            rows.append(("drawn surface", f"{name}, SHA-256 {digest[:16]}"))
    calibration = _calibration(folder)
    if report.get("calibration_hash"):
        rows.append(("calibration", f"hash {report['calibration_hash']}, {_age(calibration, report)}"))
    for device, serial in (calibration.get("identities") or {}).items():
        rows.append((f"{device}, serial number", str(serial)))
    if calibration.get("kinematics"):
        rows.append(("arm, kinematics", str(calibration["kinematics"])))
    if report.get("configuration_hash"):
        rows.append(("configuration", f"hash {report['configuration_hash']}"))
    rows.append(("program", f"assembly-cell {report.get('version', 'of another version')}"))
    return [TableRow(row) for row in rows]


def _calibration(folder: Path) -> dict[str, Any]:
    try:
        told = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return told if isinstance(told, dict) else {}


def _age(calibration: Mapping[str, Any], report: Mapping[str, Any]) -> str:
    date = f"made {report.get('calibration_date')}"
    try:
        seconds = datetime.fromisoformat(str(report["started"])).timestamp() - float(calibration["made"])
    except (KeyError, ValueError):
        return date
    unit, size = next(((u, s) for u, s in (("days", 86400), ("h", 3600), ("min", 60)) if seconds >= 2 * s), ("s", 1))
    return f"{date}, {seconds / size:.0f} {unit} before the run"


def compared(report: Mapping[str, Any]) -> list[TableRow]:
    """Where the surface was found, where the part ended, and where it was first touched.

    Cells: quantity, nominal, actual, deviation, tolerance, uncertainty (95 %). The surface may lie anywhere: the part
    goes with it. What has to keep the tolerance is the part on the surface.
    """
    rows: list[Row] = []
    found = _result(report, "invert_pose")
    tolerance = report.get("tolerance") or {}
    if found is not None and report.get("place_pose") and report.get("place_sigma"):
        sigma = report["place_sigma"]
        for about, unit, sigmas in (("", "mm", "translation_mm"), ("about ", "mrad", "rotation_mrad")):
            for axis, off, one in zip(AXES, found[f"correction_{unit}"], sigma[sigmas], strict=True):
                shown, unsure = f"{off:+.3f} {unit}", f"± {K95 * one:.3f} {unit}"
                rows.append((f"surface {about}{axis}, from the board", f"0 {unit}", shown, shown, "follows it", unsure))
    bound, truth = report.get("place_bound_95"), report.get("truth")
    if bound is not None:
        allowed = f"at most {tolerance['translation_mm']:g} mm" if "translation_mm" in tolerance else ""
        for name in (*AXES, "d"):
            most = None if truth is None else truth["error_mm"][name]["max"]
            actual = "not measured" if most is None else f"{most:.3f} mm"
            of = "part's points, largest D" if name == "d" else f"part's points, largest along {name}"
            rows.append((of, "0 mm", actual, "" if most is None else actual, allowed if name == "d" else "",
                         f"{bound[name]:.3f} mm"))  # fmt: skip
    touch = (_result(report, "place") or {}).get("touch")
    if touch is not None:
        felt = (f"{touch[key]:.3f} mm" for key in ("expected_mm", "felt_mm"))
        off, unsure = f"{touch['off_mm']:+.3f} mm", f"± {K95 * touch['sigma_mm']:.3f} mm"
        limit = next((row.cells[2] for row in judged(report) if row.cells[0].startswith("first touch")), "")
        rows.append(("first touch above the place", *felt, off, limit, unsure))
    return [TableRow(row) for row in rows]


def _result(report: Mapping[str, Any], step: str) -> Mapping[str, Any] | None:
    made = next((row.get("result") for row in report.get("steps") or () if row.get("name") == step), None)
    return made if isinstance(made, dict) and "summary_missing" not in made else None


def judged(report: Mapping[str, Any]) -> list[TableRow]:
    """Every figure beside its limit, and whether it keeps it."""
    return [
        TableRow((str(row["name"]), shown_value(row), shown_limit(row)), bool(row.get("kept", True)))
        for row in report.get("measured") or ()
    ]
