"""The page of a run: one HTML file that asks nobody for anything, for a browser and for paper.

Its verdict and its tables are text: what was used, what was judged, and nominal beside actual.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from cell.run.folder import Report, read_report
from cell.run.report.figures import noise_rows, shown_limit, shown_value, simulated_words
from cell.run.report.page import render
from cell.run.report.page.course import Timeline, Trend, past_runs, timeline
from cell.run.report.page.surface import SurfaceView, surface_view
from drivers.errors import CellError

MOST_BYTES = 3_000_000
"""Size of a page; photographs that would make it larger are left out, and that is said."""
MOST_EDGE = 900
"""Longer edge of a picture in px; a larger one is made smaller."""
QUALITY = 82
MOST_LAST = 6

Row = tuple[str, ...]
K95 = 1.96
"""Standard deviations within which 95 % of a normal distribution lie."""
AXES = "xyz"


class RunVerdict(NamedTuple):
    """What a run came to in one line, beside the tolerance, and whether its outcome is a good one."""

    words: str
    good: bool


class TableRow(NamedTuple):
    """A row of a table; with `kept` False its figure is outside its limit."""

    cells: Row
    kept: bool = True


class Photograph(NamedTuple):
    """A picture as JPEG and what it shows; a `wide` one takes both columns."""

    caption: str
    jpeg: bytes
    wide: bool


class RunPage(NamedTuple):
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


def _run_page(folder: Path, report: Report) -> RunPage:
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
        run=str(report["run"]), what=f"Job {report.get('job')}" if kind == "job" else kind.capitalize(),
        outcome=str(report["outcome"]), simulated=simulated_words(report.get("simulated")),
        world=f"seed {report.get('seed')}, level {report.get('level')}", verdict=verdict(report),
        reason=str(report.get("reason") or ""), refused=refused, judged=judged(report), compared=compared(report),
        surface=surface, unreadable=unreadable, course=timeline(folder, report),
        trend=Trend(past_runs(folder, report), tolerance) if kind == "job" else None, used=identities(folder, report),
        noise=[TableRow(row) for row in noise_rows(noise)], noise_level=str(noise.get("level") or ""),
    )  # fmt: skip


def _with_photographs(page: RunPage, folder: Path, report: Report, room: int) -> RunPage:
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
    return page._replace(photographs=shown, left_out=left_out)


def chosen(folder: Path, report: Report) -> list[tuple[Path, str]]:
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


def verdict(report: Report) -> RunVerdict:
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


def identities(folder: Path, report: Report) -> list[TableRow]:
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


def _age(calibration: Mapping[str, Any], report: Report) -> str:
    date = f"made {report.get('calibration_date')}"
    try:
        seconds = datetime.fromisoformat(str(report["started"])).timestamp() - float(calibration["made"])
    except (KeyError, ValueError):
        return date
    unit, size = next(((u, s) for u, s in (("days", 86400), ("h", 3600), ("min", 60)) if seconds >= 2 * s), ("s", 1))
    return f"{date}, {seconds / size:.0f} {unit} before the run"


def compared(report: Report) -> list[TableRow]:
    """Where the surface was found, where the part ended, and where it was first touched.

    Cells: quantity, nominal, actual, deviation, tolerance, uncertainty (95 %). The surface may lie anywhere: the part
    goes with it. What has to keep the tolerance is the part on the surface.
    """
    return [TableRow(row) for row in (*_surface_rows(report), *_part_rows(report), *_touch_rows(report))]


def _surface_rows(report: Report) -> Iterator[Row]:
    found, sigma = _result(report, "invert_pose"), report.get("place_sigma")
    if found is None or not report.get("place_pose") or not sigma:
        return
    for about, unit, sigmas in (("", "mm", "translation_mm"), ("about ", "mrad", "rotation_mrad")):
        for axis, off, one in zip(AXES, found[f"correction_{unit}"], sigma[sigmas], strict=True):
            shown, unsure = f"{off:+.3f} {unit}", f"± {K95 * one:.3f} {unit}"
            yield f"surface {about}{axis}, from the board", f"0 {unit}", shown, shown, "follows it", unsure


def _part_rows(report: Report) -> Iterator[Row]:
    bound, truth = report.get("place_bound_95"), report.get("truth")
    if bound is None:
        return
    tolerance = (report.get("tolerance") or {}).get("translation_mm")
    seen = _result(report, "verify") or (report.get("refusal") or {}).get("placed")
    for k, name in enumerate((*AXES, "d")):
        off, which = "", "largest"
        if truth is not None:
            off = f"{truth['error_mm'][name]['max']:.3f} mm"
        elif seen is not None and not seen.get("unseen"):
            off, which = f"{seen['off_mm'] if name == 'd' else abs(seen['shift_mm'][k]):.3f} mm", "as seen, mean"
        of = f"part's points, {which} D" if name == "d" else f"part's points, {which} along {name}"
        allowed = f"at most {tolerance:g} mm" if name == "d" and tolerance is not None else ""
        yield of, "0 mm", off or "not measured", off, allowed, f"{bound[name]:.3f} mm"


def _touch_rows(report: Report) -> Iterator[Row]:
    if (touch := (_result(report, "place") or {}).get("touch")) is None:
        return
    limit = next((row.cells[2] for row in judged(report) if row.cells[0].startswith("first touch")), "")
    expected, felt = (f"{touch[key]:.3f} mm" for key in ("expected_mm", "felt_mm"))
    unsure = f"± {K95 * touch['sigma_mm']:.3f} mm"
    yield "first touch above the place", expected, felt, f"{touch['off_mm']:+.3f} mm", limit, unsure


def _result(report: Report, step: str) -> Mapping[str, Any] | None:
    made = next((row.get("result") for row in report.get("steps") or () if row.get("name") == step), None)
    return made if isinstance(made, dict) and "summary_missing" not in made else None


def judged(report: Report) -> list[TableRow]:
    """Every figure beside its limit, and whether it keeps it."""
    return [
        TableRow((str(row["name"]), shown_value(row), shown_limit(row)), bool(row.get("kept", True)))
        for row in report.get("measured") or ()
    ]
