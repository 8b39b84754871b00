"""Tables of a calibration from a folder of recorded frames, for people; scripts take the JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table


def print_recorded(result: Mapping[str, Any]) -> None:
    """What was understood, frame by frame and of the poses, then what was found, then what could not be had."""
    console = Console()
    if result["board"] is not None:
        console.print(_frames(result["frames"]))
        _print_stripes(console, result)
    else:
        for pair in result["frames"]:
            if not pair["used"]:
                console.print(f"{pair['name']} not used: {pair['text']}", markup=False, soft_wrap=True)
    _print_poses(console, result)
    values = _table("calibration", ("quantity", "value", "unit"), right=1)
    camera, hand, plane = result["intrinsics"], result["hand_eye"], result["light_plane"]
    if camera is not None:
        for name in ("fx", "fy", "cx", "cy"):
            values.add_row(f"camera {name}", f"{camera[name]:.3f} ± {camera['sigma_px'][name]:.3f}", "px")
        for name in ("k1", "k2", "p1", "p2", "k3"):
            values.add_row(f"camera {name}", f"{camera[name]:.5f}", "")
        values.add_row("RMS of the board's points", f"{camera['rms_px']:.4f}", "px")
    if hand is not None:
        setup = f"hand-eye ({hand['setup'].replace('_', ' ')})"
        for axis, value, sigma in zip("xyz", hand["translation_mm"], hand["sigma_mm"], strict=True):
            values.add_row(f"{setup} {axis}", f"{value:.3f} ± {sigma:.3f}", "mm")
        for axis, value, sigma in zip("xyz", hand["rotation_vector_rad"], hand["sigma_deg"], strict=True):
            values.add_row(f"{setup} rotation {axis}", f"{value:.5f} ± {math.radians(sigma):.5f}", "rad")
        values.add_row("scatter of the board", f"{hand['scatter_mm']:.3f}", "mm")
        values.add_row("scatter of the board", f"{hand['scatter_deg']:.4f}", "deg")
    if plane is not None:
        values.add_row("light plane normal", ", ".join(f"{v:.5f}" for v in plane["normal"]), "")
        values.add_row("light plane distance", f"{plane['distance_mm']:.3f}", "mm")
        low, high = plane["depth_range_mm"]
        values.add_row("light plane seen from the camera at", f"{low:.0f} … {high:.0f}", "mm")
        values.add_row("light plane RMS", f"{plane['rms_mm']:.4f}", "mm")
        if plane["sigma_place_mm"] is not None:
            values.add_row("light plane σ where it was seen", f"{plane['sigma_place_mm']:.4f}", "mm")
            values.add_row("light plane σ of its normal", f"{plane['sigma_normal_deg']:.4f}", "deg")
    if values.row_count:
        console.print(values)
    if result["flatness"] is not None:
        console.print(_flatness(result["flatness"]))
    if result["checks"]:
        console.print(_checks(result["checks"]))
    for part, text in result["refused"].items():
        console.print(f"REFUSED {part.replace('_', '-')}: {text}", markup=False, soft_wrap=True)
    for note in result["notes"]:
        console.print(note, markup=False, soft_wrap=True)


def _print_stripes(console: Console, result: Mapping[str, Any]) -> None:
    laser = result["laser"]
    if laser is not None and any(frame["stripe"] or frame["stripe_text"] for frame in result["frames"]):
        text = f"laser: read in {laser['channel']}"
        if laser["asked"] == "auto":
            votes = ", ".join(f"{name} in {count}" for name, count in laser["votes"].items()) or "in none"
            text += f"; of {laser['looked']} pictures looked at it stands out best: {votes}"
        console.print(text, markup=False, soft_wrap=True)
    names = {"second_line": "a second line", "reflection": "a reflection"}
    for key, name in names.items():
        counts = {f["name"]: f["stripe_left_out"].get(key, 0) for f in result["frames"]}
        if any(counts.values()):
            parts = ", ".join(f"{count} in {frame}" for frame, count in counts.items() if count)
            console.print(f"points not used for {name} beside them: {parts}", markup=False, soft_wrap=True)


def _print_poses(console: Console, result: Mapping[str, Any]) -> None:
    poses = result["poses"]
    if poses is not None and poses.get("reading") is not None:
        chosen = "as given" if "poses" in poses["given"] else "chosen by the pictures"
        lines = (
            f"poses: {', '.join(poses['source'])}, {poses['text']} ({poses['reading']}, {chosen}), in {poses['unit']}; "
            f"matched by {poses['matched_by']}; {poses['setup'].replace('_', ' ')} (if they are base_from_flange)",
            f"evidence: {poses['evidence']}",
        )
        for line in lines:
            console.print(line, markup=False, soft_wrap=True)
    for file in result["unread"]:
        console.print(f"not understood: {file['name']}: {file['reason']}", markup=False, soft_wrap=True)


def _frames(frames: Sequence[Mapping[str, Any]]) -> Table:
    table = _table("recorded frames", ("picture", "board", "pose", "stripe", "used", "RMS in px", "reason"), right=5)
    for frame in frames:
        rms = "" if frame["rms_px"] is None else f"{frame['rms_px']:.3f}"
        table.add_row(
            frame["name"],
            f"{frame['points']} points" if frame["points"] else "",
            frame["pose_from"] or "",
            frame["stripe_from"] or ("here" if frame["stripe"] else ""),
            "yes" if frame["used"] else "no",
            rms,
            frame["text"],
        )
    return table


def _checks(checks: Sequence[Mapping[str, Any]]) -> Table:
    table = _table("checks", ("of", "what", "found", "doubtful from", "refused from", "unit"), right=2)
    for check in checks:
        found = "not known" if check["value"] is None else f"{check['value']:.3g}"
        mark = {"ok": "", "doubt": " ?", "refused": " !"}[check["verdict"]]
        limit = "" if check["refused_from"] is None else f"{check['refused_from']:.3g}"
        part = check["part"].replace("_", "-")
        table.add_row(part, check["name"], found + mark, f"{check['doubt_from']:.3g}", limit, check["unit"])
    return table


def _flatness(flat: Mapping[str, Any]) -> Table:
    title = f"flatness of the board in the {flat['frame']}, end to end, mm"
    table = _table(title, ("points of", "RMS", "left out", "staged"), right=1)
    other = [flat["leave_one_out"], flat["staged"]]

    def shown(part: Mapping[str, Any] | None, key: str) -> str:
        return "" if part is None or part[key] is None else f"{part[key]:.3f}"

    for k, frame in enumerate(flat["per_frame"]):
        rest = [shown(None if part is None else part["per_frame"][k], "rms_mm") for part in other]
        table.add_row(frame["name"], shown(frame, "rms_mm"), *rest)
    table.add_section()
    table.add_row("all frames", shown(flat, "rms_mm"), *(shown(part, "rms_mm") for part in other))
    table.add_row("95 % within", shown(flat, "p95_mm"), *(shown(part, "p95_mm") for part in other))
    table.add_row(f"{flat['points']} points", *(["×".join(f"{v:.0f}" for v in flat["extent_mm"])] + [""] * 2))
    return table


def _table(title: str, columns: Sequence[str], right: int) -> Table:
    """A table whose columns from `right` on hold numbers, the last one but text where it is a unit or a reason."""
    table = Table(title=title)
    for k, name in enumerate(columns):
        table.add_column(name, justify="right" if k >= right and name not in ("unit", "reason") else "left")
    return table
