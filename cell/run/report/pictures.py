"""The picture of a run for the person at the cell: the board as found, the surface, the place error or the reason.

Each panel shows what the run has of it. Where a run ended early the panels show what was looked at, and why that did
not do. The panels themselves are drawn in `panels.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from matplotlib.figure import Figure

from cell.config.job import Job
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface, PlacePose
from cell.measure.reconstruction import Cloud
from cell.measure.vision import BoardView
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.frame_store import FrameStore
from cell.procedures.steps.drive_to_target import VehicleArrival
from cell.procedures.steps.reconstruct import Reconstruction
from cell.procedures.sweep.sweep_record import SweepRecord
from cell.run.report.evidence import RefusalEvidence, ended_in
from cell.run.report.figures import simulated_words
from cell.run.report.panels import (
    BoardPanel,
    StripePanel,
    SurfacePanel,
    draw_board,
    draw_error,
    draw_reason,
    draw_stripe,
    draw_surface,
    empty,
)
from drivers.interfaces import Frame
from statemachine.runner import RunResult

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


def draw_run(
    path: Path, job: Job, nominal: NominalSurface, result: RunResult, report: Mapping[str, Any], frames: FrameStore
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
    left, *middle, right = figure.subplots(
        1,
        2 + scanned,
        width_ratios=[1.0, 1.3, 1.0] if scanned else [1.5, 1.0],
        gridspec_kw={**MARGINS, "top": MARGINS["top"] - TITLE_LINE * len(seams)},
    )
    if board is None:
        empty(left, "the board", "not photographed")
    else:
        draw_board(left, board)
    if surface is not None:
        draw_surface(figure, middle[0], surface, SCALE_SHARE * 1e3 * job.place.tolerance, seams)
    elif stripe is not None:
        draw_stripe(middle[0], stripe)
    if report["outcome"] == "placed":
        draw_error(right, report["truth"], report["place_bound_95"], 1e3 * job.place.tolerance)
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


def _stripe(result: RunResult, frames: FrameStore) -> StripePanel | None:
    """The middle of the sweep, or the last frame of one that broke off."""
    sweep = result.results.get("laser_sweep")
    if isinstance(sweep, SweepRecord):
        profile = sweep.middle_profile
        rows = profile.rows.astype(float)
        return StripePanel(sweep.middle.image, np.column_stack([profile.centres[profile.rows], rows]))
    if frames.last is not None and frames.last[0] == "stripe":
        return StripePanel(frames.last[1].image, None)
    return None
