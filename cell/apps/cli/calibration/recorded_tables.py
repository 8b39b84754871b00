"""What a calibration from recorded frames says to people: a verdict for each part; scripts take the JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from cell.apps.cli.options import new_table

Result = Mapping[str, Any]
PARTS = {"intrinsics": "camera", "hand_eye": "hand-eye", "light_plane": "light plane"}


def print_recorded(result: Result, details: bool = False) -> None:
    """Which pictures were used, how poses were read, and one verdict for each part; with `details` all there is."""
    console = Console()

    def say(text: str) -> None:
        console.print(text, markup=False, soft_wrap=True, highlight=False)

    frames = result["frames"]
    say(f"{sum(f['used'] for f in frames)} of {len(frames)} used")
    for frame in frames:
        if not frame["used"]:
            say(f"{frame['name']} not used: {frame['text']}")
    _say_poses(say, result)
    if details:
        _print_details(console, say, result)
    for line in verdicts(result):
        say(line)
    if not details:
        say("More with --details.")


def _print_details(console: Console, say: Callable[[str], None], result: Result) -> None:
    """Every picture, value, check and note."""
    if result["board"] is not None:
        rows = [
            (f["name"], f["points"], f["pose_from"], f["stripe_from"] or ("here" if f["stripe"] else ""), f["rms_px"])
            for f in result["frames"]
        ]
        console.print(_table("recorded frames", ("picture", "points", "pose", "stripe", "RMS in px"), rows))
    for part, name in PARTS.items():
        found = result[part] or result["refused_values"].get(part)
        if found is not None:
            title = name if result[part] is not None else f"{name}, REFUSED"
            console.print(_table(title, ("quantity", "value"), _plain(found)))
    if result["flatness"] is not None:
        flat = result["flatness"]
        frames_flat = [(f["name"], f["rms_mm"]) for f in flat["per_frame"]]
        whole = [("all frames", flat["rms_mm"]), ("95 % within", flat["p95_mm"])]
        title = f"flatness of the board in the {flat['frame']}, end to end, mm"
        console.print(_table(title, ("points of", "RMS"), frames_flat + whole))
    checks = [
        (PARTS[c["part"]], c["name"], c["value"], c["doubt_from"], c["refused_from"], c["unit"], c["verdict"])
        for c in result["checks"]
    ]
    console.print(_table("checks", ("of", "what", "found", "doubtful from", "refused from", "unit", ""), checks))
    for note in result["notes"]:
        say(note)


def verdicts(result: Result) -> list[str]:
    """One line for each part: its value ± σ, used or refused, and the reason in one sentence."""
    lines = []
    for part, name in PARTS.items():
        refused = result["refused"].get(part)
        value = _values(part, result[part] or result["refused_values"].get(part))
        texts = [
            c["text"].split(": ", 1)[-1] for c in result["checks"] if c["part"] == part and c["verdict"] == "doubt"
        ]
        ran = sum(c["part"] == part for c in result["checks"])
        if refused:
            lines.append(f"{name}: REFUSED{f' (do not use: {value})' if value else ''}: {refused}")
        elif value:
            reason = f"doubtful: {texts[0]}" if texts else f"all {ran} checks are well"
            lines.append(f"{name}: {value}; used; {reason}" + (f" ({len(texts) - 1} more doubts)" if texts[1:] else ""))
        else:
            said = (f"no {name.replace(' ', '-')}", f"no {name}", f"no {part}")
            why = next((note for note in result["notes"] if any(word in note for word in said)), "not asked for")
            lines.append(f"{name}: none: {why}")
    return lines


def _values(part: str, found: Result | None) -> str:
    if found is None:
        return ""
    if part == "intrinsics":
        return ", ".join(f"{n} {found[n]:.2f} ± {found['sigma_px'][n]:.2f}" for n in ("fx", "fy", "cx", "cy")) + " px"
    if part == "hand_eye":
        pairs = zip("xyz", found["translation_mm"], found["sigma_mm"], strict=True)
        place = ", ".join(f"{axis} {value:.2f} ± {sigma:.2f}" for axis, value, sigma in pairs)
        return f"{found['setup'].replace('_', ' ')}, {place} mm, turn ± {max(found['sigma_deg']):.3f} deg"
    sigma = found["sigma_place_mm"]
    place = "" if sigma is None else f" ± {sigma:.3f}"
    return f"normal {', '.join(f'{v:.4f}' for v in found['normal'])}, distance {found['distance_mm']:.2f}{place} mm"


def _say_poses(say: Callable[[str], None], result: Result) -> None:
    poses = result["poses"]
    if poses is not None and poses.get("reading") is not None:
        chosen = "as given" if "poses" in poses["given"] else "chosen by the pictures"
        say(
            f"poses: {', '.join(poses['source'])}, {poses['text']} ({poses['reading']}, {chosen}), in {poses['unit']}; "
            f"matched by {poses['matched_by']}; {poses['setup'].replace('_', ' ')} (if they are base_from_flange)\n"
            f"evidence: {poses['evidence']}"
        )
    laser = result["laser"]
    if laser is not None and any(frame["stripe"] for frame in result["frames"]):
        say(f"laser: read in {laser['channel']}")
    for file in result["unread"]:
        say(f"not understood: {file['name']}: {file['reason']}")


def _plain(found: Result) -> list[tuple[str, object]]:
    """Numbers and lists of numbers of a part, without what is nested deeper."""
    rows: list[tuple[str, object]] = []
    for key, value in found.items():
        if isinstance(value, Mapping):
            rows += [(f"{key} {name}", v) for name, v in value.items() if isinstance(v, (int, float))]
        elif not isinstance(value, list) or all(isinstance(v, (int, float)) for v in value):
            rows.append((key, value))
    return rows


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> Table:
    table = new_table(title, *columns)
    for row in rows:
        table.add_row(*map(_shown, row))
    return table


def _shown(value: object) -> str:
    if isinstance(value, list):
        return ", ".join(map(_shown, value))
    if isinstance(value, float):
        return f"{value:.5g}" if math.isfinite(value) else "not known"
    return "" if value is None else str(value)
