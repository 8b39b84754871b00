"""What a person sees: the end of a run on one screen, the list of runs, a calibration.

The screen has 80 columns by 24 lines with the prompt: how the run ended, its steps, what was measured beside its limit,
what went wrong on the way, where the report is, and what to type next.
"""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from cell.apps.cli.options import new_table
from cell.config.files import DEVICES
from cell.run.folder import wall_seconds
from cell.run.report.figures import following_words, noise_rows, shown_limit, shown_value, simulated_words
from drivers.errors import MeasuredRow

if TYPE_CHECKING:
    from cell.run.batch import BatchOutcome

WIDTH, HEIGHT = 80, 23
"""What a screen holds; its last line is left to the prompt."""
REASON_LINES = 3
"""Of the reason on that screen, at least; where there is less else to show, it has more."""
LABEL = 10
"""Columns of the words at the left edge."""


def end_screen(report: Mapping[str, Any], folder: Path, width: int = WIDTH, *, whole: bool = False) -> list[str]:
    """The lines for a report, at most `HEIGHT` of at most `width` columns; a longer path or command goes on below.

    With `whole` nothing of the reason or the figures is left out, however many lines that takes.
    """
    width = max(width, 60)
    steps, measured = _steps(report), list(report.get("measured") or ())
    followed = report.get("following")
    late = _labelled("followed", following_words(followed), width) if followed else []
    tail = [*_trouble(report, width), *late, *_labelled("report", f"{_from_here(folder)}/report.json", width)]
    if (advice := next_step(report, folder)) is not None:
        tail += _labelled("next", advice, width)
    room = HEIGHT - 1 - len(steps) - len(tail) - (2 if measured else 1)
    text = f"{report['outcome']}  {report.get('reason', '')}"
    most = len(text) if whole else max(REASON_LINES, room - max(0, min(len(measured), room - REASON_LINES)))
    head = [*_cut_lines(text, width, most), _cut(_facts(report), width)]
    figures = [_cut(_figure(row), width) for row in measured]
    fit = len(figures) if whole else max(0, room + 1 - len(head))
    more = f"  … and {len(figures) - fit} more: cell report {folder.name.split('-')[-1]}" if len(figures) > fit else ""
    return [*head, *steps, *([""] * bool(figures[:fit])), *figures[:fit], more, *tail]


def _look_at_part(report: Mapping[str, object]) -> str | None:
    """What a person has to do about the part before the next job, if anything."""
    match report.get("part"), report.get("job_kind"), report["outcome"]:
        case _, _, "placed" | "done":
            return None
        case "released", _, _:
            return "look at the part, it is down"
        case "unknown", _, _:
            return "look what has become of the part"
        case ("held", "unload", _) | ("held", "load", "refused"):
            return "take the part out of the claw"
    return None


def next_step(report: Mapping[str, object], folder: Path) -> str | None:
    """What a person would type after a run that ended so; None where there is nothing to add."""
    outcome, kind, name = report["outcome"], report.get("kind", "job"), folder.name.split("-")[-1]
    where = _where(folder)
    look = f"cell diag{where}: the state of every device; "
    again, see = (_dry_run(report), "") if report.get("simulated") is True else ("cell run", look)
    again += where
    if job := report.get("for_job"):
        other = see or "another --seed draws another world; " * (outcome == "refused")
        return f"{other}put that right, then {again} -j {_job({'job_file': job})}"
    if kind != "job":
        if outcome == "done":
            return f"cell calibrate verify{where}: how good it is" if kind == "calibration" else None
        return f"cell diag{where}: the state of every device"
    if (first := _look_at_part(report)) is not None:
        return f"{first}; cell home{where}: fold the arm; then {again} -j {_next_job(report)}"
    match outcome:
        case "done":
            return f"cell report {name}{where}: what was measured; nothing was placed"
        case "placed" if _next_item(report):
            return f"{again} -j {_next_job(report)}: the next item; cell report {name}{where}: this one"
        case "placed":
            return f"cell report {name}{where} --html: all of it as a page; cell export{where}: the cloud"
        case "refused" if report.get("code") == "CalibrationStale":
            return f"cell calibrate{where}, then {again} -j {_job(report)}"
        case "refused":
            why = "picture.png beside it shows why; " * (folder / "picture.png").is_file()
            return f"{why}put that right, then {again} -j {_job(report)}"
        case "faulted" | "aborted":
            return f"{see if outcome == 'faulted' else ''}cell resume {name}{where}: go on with the job"
    return f"cell abort {name}{where}, if it is still going on; cell resume {name}{where}, if its process died"


def _where(folder: Path) -> str:
    """The option that names a run's cell, where it is not that of the present folder."""
    config = folder.parent.parent / "cell.toml"
    here = folder.parent.resolve() == Path("runs").resolve() or not config.is_file()
    return "" if here else f" -c {shlex.quote(_from_here(config))}"


def _dry_run(report: Mapping[str, object]) -> str:
    """The command for the same simulated world, without defaults; on the virtual clock where this computer was too busy
    for the wall's. A calibration's report tells that in its reason alone."""
    if ".owner_frozen)" in str(report.get("reason")):
        report = {**report, "clock": "virtual"}
    usual = {"seed": 1, "level": "nominal", "clock": "wall"}
    options = (f"--{key} {report[key]}" for key, value in usual.items() if report.get(key, value) != value)
    return " ".join(["cell dry-run", *options])


def _next_item(report: Mapping[str, object]) -> object:
    """The item after the one whose part is down, if any: not in a dry run, whose next one has a world of its own."""
    return None if report.get("simulated") is True or report.get("part") != "released" else report.get("next_item")


def _next_job(report: Mapping[str, object]) -> str:
    """Another one of that job, or its next item."""
    return _job({"job_file": item} if (item := _next_item(report)) else report)


def _job(report: Mapping[str, object]) -> str:
    """The job as one would name it: the shipped ones by their names, others by their files."""
    from cell.config.job import job_and_item, job_path, shipped_jobs

    file, number = job_and_item(str(report.get("job_file", report.get("job"))))
    path, item = Path(file), "" if number is None else f"#{number}"
    if path.suffix == ".toml" and path.stem in shipped_jobs() and path == job_path(path.stem):
        return path.stem + item
    return shlex.quote(_from_here(path) + item)


def duration(seconds: float | None) -> str:
    """A duration for people."""
    if seconds is None:
        return ""
    if seconds < 99.5:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


def _facts(report: Mapping[str, object]) -> str:
    kind = str(report.get("kind", "job"))
    facts = [f"job {report.get('job')}" if kind == "job" else kind]
    if stop := report.get("stop"):
        facts[0] += f" at stop {stop}"
    if words := simulated_words(report.get("simulated")):
        facts.append(f"{words}, seed {report.get('seed')}, level {report.get('level')}")
        if report.get("clock") == "wall" and isinstance(pace := report.get("speed"), float | int):
            facts[-1] += f", speed {pace:g}"
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


def _figure(row: MeasuredRow) -> str:
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
    told = "; ".join(f"{_named(fault)} in {fault.get('step')}, {fault.get('remedy')}" for fault in faults)
    lines = [_cut(f"{'faults':<{LABEL}}{len(faults)}: {told}" if faults else f"{'faults':<{LABEL}}none", width)]
    again = ", ".join(f"{row['name']} {row['retries']}" for row in retried) or "none"
    return [*lines, _cut(f"{'retries':<{LABEL}}{again}", width)]


def _named(fault: Mapping[str, Any]) -> str:
    """The code of a device's fault; a refusal is none of a device."""
    return "a refusal" if fault.get("code") == "RefusedError" else str(fault.get("code"))


def _labelled(label: str, text: str, width: int) -> list[str]:
    lines = textwrap.wrap(text, width - LABEL, break_on_hyphens=False)
    return [f"{label if k == 0 else '':<{LABEL}}{line}" for k, line in enumerate(lines)]


def _from_here(path: Path) -> str:
    """A path, from the present folder if it lies below."""
    here, path = Path.cwd(), path.resolve()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


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


COLOURS = {
    "placed": "green", "done": "green", "refused": "yellow", "misplaced": "red", "faulted": "red", "aborted": "magenta",
}  # fmt: skip


def print_report(report: Mapping[str, Any], folder: str, *, noise: bool = False, whole: bool = False) -> None:
    """The end of a run for people, on one screen; `whole` leaves out nothing.

    With `noise` the noise that is assumed and the seams stand below it.
    """
    console = Console(highlight=False)
    outcome = str(report["outcome"])
    first, *others = end_screen(report, Path(folder), console.width, whole=whole)
    console.print(f"[bold {COLOURS.get(outcome, 'white')}]{outcome}[/]", end="")
    console.print(first.removeprefix(outcome), markup=False, soft_wrap=True)
    for line in others:
        console.print(line, markup=False, soft_wrap=True, style="bold red" if line.startswith("! ") else None)
    if not noise:
        return
    if seams := (report.get("scan") or {}).get("seams"):
        _print_seams(console, seams)
    assumed = report.get("assumed_noise") or {}
    table = new_table(f"assumed noise, 1 sigma (level {assumed.get('level')})", "of", ">sigma", "unit")
    for row in noise_rows(assumed):
        table.add_row(*row)
    console.print(table)


def print_late(report: Mapping[str, object]) -> None:
    """Say that the program was asked to end when the run had come to its end already. Writes to standard error."""
    part = "the part had been placed" if report["outcome"] == "placed" else f"the run had ended {report['outcome']}"
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    console.print(f"interrupted after {part}", style="bold magenta", markup=False)


def print_batch(batch: BatchOutcome) -> None:
    """What came of a batch: each figure of the placed parts, how many parts ended how, and why it ended."""
    console = Console(highlight=False)
    columns = ("figure", ">n", ">mean", ">sd", ">min", ">max", "unit")
    table = new_table("placed parts", *columns)
    for row in batch.figures:
        numbers = ("" if value is None else f"{value:.4g}" for value in (row.mean, row.sd, row.min, row.max))
        table.add_row(row.name, str(row.n), *numbers, row.unit)
    console.print(table)
    counts = ", ".join(f"{number} {name}" for name, number in batch.counts.items())
    console.print(f"{counts}: {batch.reason}\nbatch     {_from_here(batch.file)}", markup=False, soft_wrap=True)


def print_runs(rows: Sequence[Mapping[str, Any]]) -> None:
    """A line for each of the rows of `cell.runs.run_row`, its reason cut to the width of the screen."""
    console = Console(highlight=False)
    if not rows:
        console.print("no run yet")
    whats = [" ".join(str(word) for word in (row["kind"], row["job"], _simulated(row)) if word) for row in rows]
    wide = max(map(len, whats), default=0)
    for row, what in zip(rows, whats, strict=True):
        begun = str(row["started"] or "")[:16].replace("T", " ")
        ended = f"{row['outcome']:<10}"
        name = str(row["run"]).split("-")[-1]
        before = f"{begun:<17}{name:<6}{what:<{wide}}  "
        after = f" {duration(row['duration_s']):>6}  {' '.join(str(row['reason'] or '').split())}"
        room = console.width - len(before) - len(ended)
        console.print(before, end="", markup=False)
        console.print(ended, end="", style=COLOURS.get(str(row["outcome"])), markup=False)
        console.print(_cut(after, room), markup=False, soft_wrap=True)


def print_health(told: Mapping[str, Any]) -> None:
    """A row for each part that the jobs look at, and when a calibration is due."""
    console = Console(highlight=False)
    if told["parts"]:
        columns = ("part", ">last", ">by now", ">limit", "unit", ">a day", ">days left", "each job")
        table = new_table(f"since the calibration of {told['calibrated']}, jobs: {told['jobs']}", *columns)
        for part in told["parts"]:
            creeps = f"{part['a_day']:.3f}" if part["a_day"] else ""
            left = "" if part["days_left"] is None else f"{part['days_left']:.0f}"
            seen = f"{part['last']:.3f}", f"{part['now']:.3f}"
            table.add_row(
                part["part"], *seen, f"{part['limit']:.2f}", part["unit"], creeps, left,
                sparks(part["values"], part["limit"]),
            )  # fmt: skip
        console.print(table)
    for shock in told["shocks"]:
        console.print(
            f"after run {shock['run']} parts may sit elsewhere: {shock['reason']}", markup=False, soft_wrap=True
        )
    if told["unlooked"]:
        console.print(f"{told['unlooked']} of {told['jobs']} jobs did not look at the fine board", markup=False)
    console.print(told["due"], markup=False, soft_wrap=True)


SPARKS = "▁▂▃▄▅▆▇█"


def sparks(values: Sequence[float], limit: float) -> str:
    """The ten newest of these values as bars; a full one has reached the limit."""
    most = len(SPARKS) - 1
    return "".join(SPARKS[min(most, int(most * value / limit))] for value in values[-10:])


def _simulated(row: Mapping[str, object]) -> str:
    which = row.get("simulated")
    if not isinstance(which, list):
        return "(sim)" if which else ""
    real = [name for name in DEVICES if name not in which]
    return f"(sim all but {','.join(real)})" if len(real) < len(which) else f"(sim {','.join(which)})"


def _print_seams(console: Console, seams: Sequence[Mapping[str, Any]]) -> None:
    columns = ("sweeps", ">points", ">mean", ">expected ±", ">rms", ">expected", ">95 % below")
    table = new_table("how far sweeps lie apart where they overlap, in mm", *columns)
    for seam in seams:
        values = (seam[f"{key}_mm"] for key in ("mean", "expected_mean", "rms", "expected_rms", "p95"))
        first, second = (str(number + 1) for number in seam["sweeps"])
        table.add_row(f"{first} and {second}", str(seam["points"]), *(f"{value:.4f}" for value in values))
    console.print(table)


def print_calibration(summary: Mapping[str, Any], where: str | None) -> None:
    """A calibration for people: values with their standard deviations, then how well the observations fit."""
    console = Console()
    lens, plane, rail, hand = (summary[key] for key in ("scan_camera", "light_plane", "rail", "hand_eye"))
    values = new_table(f"calibration of {summary['date']}", "quantity", ">value", ">sigma", "unit")
    for name, unit in (("fx", "px"), ("fy", "px"), ("cx", "px"), ("cy", "px"), ("k1", "")):
        values.add_row(f"scan camera {name}", f"{lens[name]:.4f}", f"{lens[f'sigma_{name}']:.4f}", unit)
    values.add_row("light plane distance", f"{plane['distance_mm']:.4f}", f"{plane['sigma_distance_mm']:.4f}", "mm")
    values.add_row("rail scale", f"{rail['scale']:.6f}", f"{rail['sigma_scale']:.6f}", "")
    for axis, value, sigma in zip("xyz", hand["translation_mm"], hand["sigma_mm"], strict=True):
        values.add_row(f"flange to scan camera {axis}", f"{value:.4f}", f"{sigma:.4f}", "mm")
    for axis, sigma in zip("xyz", hand["sigma_mrad"], strict=True):
        values.add_row(f"turn about flange {axis}", "", f"{sigma:.4f}", "mrad")
    if (since := summary["laser_since"]) is not None:
        turned = f"laser turned since, verified {since['date']}"
        values.add_row(turned, f"{since['turned_mrad']:+.4f}", f"{since['sigma_mrad']:.4f}", "mrad")
    if (timing := summary["timing"]) is not None:
        late = f"time stamps late, measured {timing['date']}"
        values.add_row(late, f"{timing['late_ms']:+.4f}", f"{timing['sigma_ms']:.4f}", "ms")
    if (shutter := summary["shutter"]) is not None:
        values.add_row("last row after the first", f"{shutter['readout_ms']:+.4f}", f"{shutter['sigma_ms']:.4f}", "ms")
    console.print(values)
    columns = (">views", ">chi²/dof", ">dots px", ">held-out px", ">stripe mm", ">held-out mm")
    fit = new_table("residuals; held-out views are predicted from the others", "camera", *columns)
    for camera in ("scan", "target"):
        q = summary[f"{camera}_quality"]
        keys = ("dots_rms_px", "held_out_dots_rms_px", "stripe_rms_mm", "held_out_stripe_rms_mm")
        shown = ["" if q.get(key) is None else f"{q[key]:.4f}" for key in keys]
        fit.add_row(camera, str(q["views"]), f"{q['chi2_per_dof']:.3f}", *shown)
    console.print(fit)
    for note in summary["notes"]:
        console.print(note, markup=False, soft_wrap=True)
    if where is not None:
        console.print(f"stored in {where}", markup=False, soft_wrap=True)
