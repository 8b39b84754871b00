"""The picture of a run for the person at the cell: the board as found, the surface, the place error or the reason.

Where a run ended early the panels show what was looked at, and why that did not do. Lengths are in mm, pictures in px;
every scale says its unit.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cell.config.job import AreaSection, Job
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface, PlacePose
from cell.measure.inversion.flush import Flush
from cell.measure.reconstruction.cloud import Cloud
from cell.measure.vision.board.view import BoardView
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.frame_store import FrameStore
from cell.procedures.part_features import FeatureSeen
from cell.procedures.placed_part import PlacedPart
from cell.procedures.steps.drive_to_target import VehicleArrival
from cell.procedures.steps.reconstruct import Reconstruction
from cell.procedures.sweep.stored_sweep import SweepRecord
from cell.run.folder import Report
from cell.run.report.evidence import RefusalEvidence, ended_in, seen_placed
from cell.run.report.figures import shown_limit, shown_value, simulated_words, texture_words
from drivers.interfaces import Frame, Image, Vector
from statemachine.runner import RunResult

LEAST_SQUARE_MM, MOST_SQUARES = 1.2, 60
"""Edge of the map's squares: a line of the sweep or more falls into each; and how many make its longer side at most."""
LEAST_MAP_MM = 25.0
NO_DATA, BESIDE = "0.8", "0.45"
GREY: dict[str, Any] = {"cmap": "gray", "vmin": 0, "vmax": 255, "interpolation_stage": "data"}
"""A picture's colours, given to what is shown of it and not to all of its pixels before."""
MARGIN = 0.35
"""Room around the board in the photograph, in its own size."""
REASON_COLUMNS, REASON_LINES = 54, 9
LINE = 0.036
"""Height of a line of text in a panel."""


class BoardPanel(NamedTuple):
    """A photograph (h, w), 8 bit, the points found in it, and their residual in px if a pose was taken from them."""

    image: Image
    view: BoardView | None
    residual_px: float | None = None
    refused: bool = False


class SurfacePanel(NamedTuple):
    """Points (n, 3) in m in the surface's frame and their deviations (n,) in m, NaN beside the surface.

    `deviation` is None when no pose of the surface was found; `believed` is False for a pose that was refused. `flush`
    is that of the placed part, where it was seen, `features` what the job names of it.
    """

    points: Vector
    deviation: Vector | None
    believed: bool
    flush: Flush | None = None
    features: tuple[FeatureSeen, ...] = ()


def draw_board(axes: Axes, board: BoardPanel) -> None:
    """The photograph, cut to the board's surroundings, with every point found drawn over it."""
    axes.imshow(board.image, **GREY)
    axes.set_xlabel("column in px")
    axes.set_ylabel("row in px")
    if board.view is None:
        _title(axes, ["the refused photograph: no board found" if board.refused else "the last photograph"])
        return
    pixels = board.view.pixels
    axes.plot(
        pixels[:, 0], pixels[:, 1], "o", color="tab:red", markerfacecolor="none", markersize=5, markeredgewidth=0.9
    )
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    room = MARGIN * (high - low).max()
    height, width = board.image.shape
    axes.set_xlim(max(0, low[0] - room), min(width, high[0] + room))
    axes.set_ylim(min(height, high[1] + room), max(0, low[1] - room))
    said = "refused" if board.residual_px is None else f"off by {board.residual_px:.3f} px RMS"
    _title(axes, [f"the board: {len(pixels)} of {len(board.view.spec.lattice())} points found, {said}"])


def draw_surface(
    figure: Figure, axes: Axes, surface: SurfacePanel, span_mm: float, seams: Sequence[Mapping[str, object]],
    waviness: Sequence[str] = (), areas: Sequence[AreaSection] = (),
) -> None:  # fmt: skip
    """A map of the scanned points from above, means over squares: their deviation from the drawn surface within
    ±`span_mm`, or their height where no place of the surface was found."""
    points = 1e3 * surface.points
    frame_map(axes, points)
    if surface.deviation is None:
        _title(axes, [f"{len(points)} points of the sweep; the surface was not found in them"])
        if len(points):
            shown = _map(axes, points, points[:, 2], cmap="viridis")
            figure.colorbar(shown, ax=axes, label="height in mm", shrink=0.8, pad=0.07)
        return
    deviation = 1e3 * surface.deviation
    on = np.isfinite(deviation)
    _map(axes, points[~on], np.zeros(int((~on).sum())), cmap=ListedColormap([BESIDE]), vmin=0.0, vmax=1.0)
    shown = _map(axes, points[on], deviation[on], cmap="RdBu_r", vmin=-span_mm, vmax=span_mm)
    figure.colorbar(shown, ax=axes, label="deviation from the drawn surface in mm", shrink=0.8, pad=0.07, extend="both")
    said = "deviation from the drawn surface" if surface.believed else "deviation at the place that was refused"
    rms = float(np.sqrt(np.mean(deviation[on] ** 2))) if on.any() else float("nan")
    title = [f"{said}: {rms:.3f} mm RMS" + ("" if on.all() else "; dark: beside it"), *map(seam_words, seams)]
    title += waviness
    if surface.flush is not None:
        x, y, _ = 1e3 * surface.flush.places.T
        axes.scatter(
            x, y, s=22.0, c=1e3 * surface.flush.higher, marker="s", cmap="RdBu_r", vmin=-span_mm, vmax=span_mm,
            edgecolors="black", linewidths=0.7,
        )  # fmt: skip
        title.append("framed: flush along the edge of the placed part")
    for area in areas:
        (x, y), (width, height) = 1e3 * area.corners[0], 1e3 * np.array(area.size)
        axes.add_patch(Rectangle((x, y), width, height, fill=False, linestyle="--"))
        axes.annotate(area.name, (x, y + height), xytext=(2, -8), textcoords="offset points", fontsize=7)
    for feature in surface.features:
        x, y = 1e3 * feature.belongs[:2]
        axes.plot(x, y, "x", color="black", markersize=6)
        axes.annotate(
            f"{feature.section.name}: {1e3 * feature.off:.2f}", (x, y), xytext=(0, 5), textcoords="offset points",
            fontsize=7, ha="center", bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none"},
        )  # fmt: skip
    if surface.features:
        title.append("crosses: features of the placed part, mm off")
    _title(axes, title)


def frame_map(axes: Axes, points: Vector) -> None:
    """Axes in mm around points (n, 3) in mm, seen from above; what carries no data is grey."""
    low, high = (points[:, :2].min(axis=0), points[:, :2].max(axis=0)) if len(points) else (np.zeros(2), np.zeros(2))
    room = np.maximum(1.0, 0.5 * (LEAST_MAP_MM - (high - low)))
    axes.set_xlim(low[0] - room[0], high[0] + room[0])
    axes.set_ylim(low[1] - room[1], high[1] + room[1])
    axes.set_aspect("equal")
    axes.set_facecolor(NO_DATA)
    axes.set_xlabel("x of the surface in mm")
    axes.set_ylabel("y in mm")


def _map(axes: Axes, points: Vector, values: Vector, **look: Any) -> Any:
    """Means of `values` (n,) over squares of the plane, drawn; squares without a point stay clear."""
    edges, mean = square_means(axes, points, values)
    return axes.pcolormesh(*edges, np.ma.masked_invalid(mean.T), **look)


def square_means(axes: Axes, points: Vector, values: Vector) -> tuple[list[Vector], Vector]:
    """Edges of the map's squares along x and y, in mm, and means of `values` (n,) in them, NaN where no point is."""
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    square = max(LEAST_SQUARE_MM, max(x1 - x0, y1 - y0) / MOST_SQUARES)
    edges = [np.arange(low, high + square, square) for low, high in ((x0, x1), (y0, y1))]
    count, _, _ = np.histogram2d(points[:, 0], points[:, 1], edges)
    total, _, _ = np.histogram2d(points[:, 0], points[:, 1], edges, weights=values)
    return edges, np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


def _title(axes: Axes, lines: Sequence[str]) -> None:
    axes.set_title("\n".join(lines), fontsize="medium")


def seam_words(seam: Mapping[str, Any]) -> str:
    """One of the report's seams in a line."""
    first, second = (number + 1 for number in seam["sweeps"])
    return (
        f"sweep {second} on sweep {first}: mean {seam['mean_mm']:+.3f} mm (expected ± {seam['expected_mean_mm']:.3f}), "
        f"rms {seam['rms_mm']:.3f} mm (expected {seam['expected_rms_mm']:.3f})"
    )


def draw_stripe(axes: Axes, image: Image, stripe: Vector | None) -> None:
    """A frame of the sweep (h, w), 8 bit, and the stripe found in it, (n, 2) px of column and row."""
    axes.imshow(image, **GREY)
    axes.set_xlabel("column in px")
    axes.set_ylabel("row in px")
    if stripe is None:
        _title(axes, ["the last frame of the sweep"])
        return
    axes.plot(stripe[:, 0], stripe[:, 1], ",", color="tab:red")
    _title(axes, [f"the middle of the sweep: the stripe found in {len(stripe)} rows"])


def draw_error(
    axes: Axes, truth: Mapping[str, Any] | None, bound: Mapping[str, Any] | None, tolerance_mm: float,
    seen: PlacedPart | None = None,
) -> None:  # fmt: skip
    """Bars by axis and for D: the true error where it is known, and what the run itself states, up to the tolerance."""
    _title(axes, ["place error beside its tolerance" if truth else "stated place error beside its tolerance"])
    names = ["x", "y", "z", "d"]
    rows: list[tuple[str, str, list[float]]] = []
    if truth is not None:
        rows.append(("true, largest of 45 points", "tab:blue", [truth["error_mm"][name]["max"] for name in names]))
        rows.append(("true, mean", "lightsteelblue", [truth["error_mm"][name]["mean"] for name in names]))
    if seen is not None:
        off = 1e3 * np.column_stack([np.abs(seen.offsets), np.linalg.norm(seen.offsets, axis=1)]).mean(axis=0)
        rows.append(("seen of the placed part, mean", "tab:green", off.tolist()))
    if bound is not None:
        rows.append(("stated: 95 % lie below", "tab:orange", [bound[name] for name in names]))
    thick = 0.8 / max(1, len(rows))
    for k, (label, colour, values) in enumerate(rows):
        places = np.arange(4) + thick * (k - 0.5 * (len(rows) - 1))
        axes.barh(places, values, 0.92 * thick, color=colour, label=label)
        for place, value in zip(places, values, strict=True):
            axes.text(value + 0.012 * tolerance_mm, place, f"{value:.3f}", va="center", fontsize=8)
    axes.axvline(tolerance_mm, color="tab:red", linestyle="--", label=f"tolerance of the job, {tolerance_mm:g} mm")
    axes.set_yticks(np.arange(4), ["x", "y", "z", "D"])
    axes.invert_yaxis()
    axes.set_xlim(0, 1.15 * max([tolerance_mm, *(value for _, _, values in rows for value in values)]))
    axes.set_xlabel("mm, axes of the surface; D: length of all three")
    small = {"fontsize": 8} if seen is None else {"fontsize": 7, "labelspacing": 0.2}
    axes.legend(**small, loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=2)


def draw_reason(axes: Axes, report: Report, step: str | None) -> None:
    """Why a run ended, and the figures that it was judged by; one that leaves its limit is red."""
    empty(axes, f"{report['outcome']}" + ("" if step is None else f" in {step}"), "")
    lines = textwrap.wrap(str(report["reason"]), REASON_COLUMNS)
    if len(lines) > REASON_LINES:
        lines = [*lines[: REASON_LINES - 1], "… (the whole of it is in report.json)"]
    _write(axes, 0.0, 1.0, "\n".join(lines), "black")
    top = 1.0 - LINE * (len(lines) + 1)
    fitting = int(top / (2.2 * LINE))
    for k, row in enumerate(report["measured"][:fitting]):
        colour = "black" if row["kept"] else "tab:red"
        name = textwrap.shorten(str(row["name"]), REASON_COLUMNS, placeholder=" …")
        words = ", ".join(part for part in (shown_value(row), shown_limit(row)) if part)
        _write(axes, 0.0, top - 2.2 * LINE * k, f"{name}\n      {words}", colour)


def _write(axes: Axes, x: float, y: float, text: str, colour: str) -> None:
    # Not part of the layout, which would make room for a long line by squeezing the panels beside it.
    axes.text(x, y, text, va="top", fontsize=10, color=colour, transform=axes.transAxes, in_layout=False)


def empty(axes: Axes, title: str, text: str) -> None:
    """A panel with nothing but words."""
    _title(axes, [title])
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)
    axes.set_axis_off()


SCALE_SHARE = 1 / 3
"""End of the colours' scale in tolerances: what lies farther off the surface counts against it."""
WIDTH, HEIGHT = 17.0, 6.0
"""Of the picture, in inches."""
MARGINS = {"left": 0.045, "right": 0.985, "bottom": 0.17, "top": 0.87, "wspace": 0.2}
"""Of the panels, in the picture's size; `wspace` in a panel's width. Fixed, because a layout that is searched for takes
as long as the whole drawing."""
COMPRESSION = 3
"""Of the picture's file, 0 to 9: the default, 6, takes twice as long for a file that is a fifth smaller."""
TITLE_LINE = 0.17 / HEIGHT
"""Height of a line of a panel's title, which a seam needs each."""
TITLE_COLUMNS = 84
"""Of the map's title."""


def draw_run(
    path: Path, job: Job, nominal: NominalSurface, result: RunResult, report: Report, frames: FrameStore
) -> None:
    """Draw a run's picture from what its steps made, from what its end shows, and from its report."""
    evidence = RefusalEvidence.of(result)
    figure = Figure(figsize=(WIDTH, HEIGHT), dpi=110)
    title = f"{report['outcome'].upper()}: run {report['run']}, job {job.job.name}"
    if words := simulated_words(report["simulated"]):
        title += f" ({words}, seed {report['seed']}, level {report['level']})"
    figure.suptitle(title)
    board, stripe = _board(result, evidence, frames), _stripe(result, frames)
    surface = _surface(job, nominal, result, evidence)
    scanned = surface is not None or stripe is not None
    seams = (report["scan"] or {}).get("seams", ())
    seen = seen_placed(result)
    if surface is not None and seen is not None and not job.unloads:
        surface = surface._replace(flush=seen.flush, features=seen.features)
    more = 0 if surface is None else (surface.flush is not None) + bool(surface.features)
    waviness = textwrap.wrap(texture_words(report), TITLE_COLUMNS)
    left, *middle, right = figure.subplots(
        1, 2 + scanned, width_ratios=[1.0, 1.3, 1.0] if scanned else [1.5, 1.0],
        gridspec_kw={**MARGINS, "top": MARGINS["top"] - TITLE_LINE * (len(seams) + more + len(waviness))},
    )  # fmt: skip
    if board is None:
        empty(left, "the board", "not photographed")
    else:
        draw_board(left, board)
    if surface is not None:
        draw_surface(
            figure, middle[0], surface, SCALE_SHARE * 1e3 * job.place.tolerance, seams, waviness=waviness,
            areas=job.surface.area,
        )  # fmt: skip
    elif stripe is not None:
        draw_stripe(middle[0], *stripe)
    if report["outcome"] == "placed":
        draw_error(right, report["truth"], report["place_bound_95"], report["tolerance"]["translation_mm"], seen)
    else:
        draw_reason(right, report, ended_in(result))
    figure.savefig(path, pil_kwargs={"compress_level": COMPRESSION})


def _board(result: RunResult, evidence: RefusalEvidence, frames: FrameStore) -> BoardPanel | None:
    """The photograph that mattered last: the refused one, one of a step that broke off, or the one measured with."""
    frame, view = evidence.seen.get("frame"), evidence.seen.get("view")
    if isinstance(frame, Frame):
        return BoardPanel(frame.image, view if isinstance(view, BoardView) else None, refused=True)
    if frames.last is not None and frames.last[0].startswith("board") and ended_in(result) is not None:
        return BoardPanel(frames.last[1].image, None)
    fix, arrival = result.results.get("board_photo"), result.results.get("drive_to_target")
    if not isinstance(fix, BoardFix) and isinstance(arrival, VehicleArrival):
        fix = arrival.fix
    if not isinstance(fix, BoardFix):
        return None
    return BoardPanel(fix.frames[-1].image, fix.views[-1] if fix.views else None, fix.residual_px)


def _surface(job: Job, nominal: NominalSurface, result: RunResult, evidence: RefusalEvidence) -> SurfacePanel | None:
    """The cloud in the surface's frame, with deviations where a pose was found, believed or not."""
    made, pose, fix = (result.results.get(name) for name in ("reconstruct", "invert_pose", "board_photo"))
    cloud = made.cloud if isinstance(made, Reconstruction) else evidence.seen.get("cloud")
    if not isinstance(cloud, Cloud):
        return None
    lines, rows = cloud.valid.nonzero()
    points = cloud.points[lines, rows]
    judged = evidence.seen.get("pose")
    base_from_surface = pose.base_from_surface if isinstance(pose, PlacePose) else judged
    if isinstance(base_from_surface, pin.SE3):
        local = transform(base_from_surface.inverse(), points)
        return SurfacePanel(local, nominal.deviations(local), believed=isinstance(pose, PlacePose))
    if isinstance(fix, BoardFix):
        drawn = fix.base_from_board * job.place_from_board.inverse() * job.surface.place_from_surface.se3()
        points = transform(drawn.inverse(), points)
    return SurfacePanel(points, None, believed=False)


def _stripe(result: RunResult, frames: FrameStore) -> tuple[Image, Vector | None] | None:
    """The middle of the sweep, or the last frame of one that broke off."""
    sweep = result.results.get("laser_sweep")
    if isinstance(sweep, SweepRecord):
        profile = sweep.middle_profile
        rows = profile.rows.astype(float)
        return sweep.middle.image, np.column_stack([profile.centres[profile.rows], rows])
    if frames.last is not None and frames.last[0] == "stripe":
        return frames.last[1].image, None
    return None
