"""From a verification's observations to its verdict: the scan camera's photographs and sweep, the target's views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from cell.measure.calibration.drift.decision import DriftVerdict, verdict
from cell.measure.calibration.drift.evidence import PictureMeasurements, dots_of, evidence
from cell.measure.calibration.drift.pointing import WitnessCheck
from cell.measure.calibration.drift.reference import Reference
from cell.measure.calibration.drift.reference_plate import Pointing
from cell.measure.calibration.observations import ScanObservation, TargetObservation
from cell.measure.calibration.solve.blocks import AdjustmentState, ViewData
from cell.measure.calibration.solve.joint import STRIPE_POINTS
from cell.measure.calibration.solve.results import ScanCalibration, TargetCalibration
from cell.measure.calibration.solve.starts import stripe_means
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import from_parts
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.stripe_on_board import points_on_board
from drivers.errors import CalibrationStale, RefusedError

SWEEP_PROFILES = 24
"""Enough of a sweep: neighbouring profiles share the rail's error."""
LEAST_PROFILES = 10
LEAST_SWEEP_M = 0.01
"""Of rail between the first and the last profile on the board.

All stripes in one place fit any board that is turned about them: what is left of their scatter is nothing at all, and
the light plane's evidence is made of rounding errors.
"""


@dataclass(frozen=True, eq=False)
class CheckObservations:
    """What a verification sees. Everything of one approach is taken with the arm at rest.

    `photographs` holds, for each approach of the arm, the photographs of the fine board at the ends of the rail's way
    (no stripe); `sweep` the profiles of the sweep over it in the last approach (no views); `target` one view of the
    large board for each approach. `pointing` is the laser's by its witness, where there is one, about `exit_point`
    (3,), m, in the scan camera's frame.
    """

    photographs: list[list[ScanObservation]]
    sweep: list[ScanObservation]
    target: list[TargetObservation]
    pointing: Pointing | None = None
    exit_point: Array = field(default_factory=lambda: np.zeros(3))


def verify(scan: ScanCalibration, target: TargetCalibration, seen: CheckObservations) -> DriftVerdict:
    """Compare with what the calibration predicts.

    Raises `CalibrationStale` for a calibration that was stored without its reference, `RefusedError` when the sweep
    does not show the board.
    """
    if scan.reference is None or target.reference is None:
        raise CalibrationStale(
            "the stored calibration holds no reference to verify against, it was made by an older program; run "
            "`cell calibrate` once"
        )
    states = {
        "scan": _state(scan, scan.reference),
        "target": AdjustmentState(
            target.camera, None, np.zeros(3), target.flange_from_camera, target.reference.base_from_board
        ),
    }  # fmt: skip
    evidences = {
        "scan": evidence(states["scan"], scan.reference, scan_looks(states["scan"], seen)),
        "target": evidence(states["target"], target.reference, target_looks(seen.target)),
    }
    return verdict(evidences, states)


def check_witness(scan: ScanCalibration, seen: CheckObservations) -> WitnessCheck | None:
    """What the board says to the laser's pointing by its witness; None without one. Raises what `verify` raises."""
    if seen.pointing is None or scan.reference is None:
        return None
    state = _state(scan, scan.reference)
    weighed = evidence(state, scan.reference, scan_looks(state, seen))
    return WitnessCheck.of(seen.pointing, seen.exit_point, state, weighed)


def _state(scan: ScanCalibration, reference: Reference) -> AdjustmentState:
    return AdjustmentState(
        scan.camera, scan.light_plane, scan.rail_direction, scan.flange_from_camera, reference.base_from_board
    )  # fmt: skip


def scan_looks(state: AdjustmentState, seen: CheckObservations) -> list[PictureMeasurements]:
    """Dots of every photograph, and the sweep's stripe where it lies cleanly on the board."""
    looks: list[PictureMeasurements] = []
    for rest, photographs in enumerate(seen.photographs):
        looks += [PictureMeasurements(dots_of(photo), rest, len(looks) + k) for k, photo in enumerate(photographs)]
    rest, stop = len(seen.photographs) - 1, len(looks)
    near = seen.photographs[-1][0]
    assert near.view is not None
    pose = board_pose(near.view, state.camera).camera_from_board
    few = seen.sweep[:: max(1, len(seen.sweep) // SWEEP_PROFILES)]
    lit = [look for profile in few if (look := _stripe(state, profile, near, pose, rest=rest, stop=stop)) is not None]
    if len(lit) < LEAST_PROFILES:
        raise RefusedError(
            f"{len(lit)} of {len(few)} profiles of the sweep cross the fine board, at least {LEAST_PROFILES} are "
            "needed; is the laser on, and does it light the board?"
        )
    way = float(np.ptp([look.data.rail for look in lit]))
    if way < LEAST_SWEEP_M:
        raise RefusedError(
            f"the stripe crosses the fine board over {1e3 * way:.1f} mm of the rail's way, at least "
            f"{1e3 * LEAST_SWEEP_M:.0f} mm are needed: does the rail move, and does the board lie in the sweep?"
        )
    return looks + lit


def target_looks(views: Sequence[TargetObservation]) -> list[PictureMeasurements]:
    """Dots of every view; each has its own approach."""
    same = [ScanObservation(o.view, None, o.base_from_flange) for o in views]
    return [PictureMeasurements(dots_of(o), k) for k, o in enumerate(same)]


def _stripe(
    state: AdjustmentState, lit: ScanObservation, near: ScanObservation, pose: pin.SE3, rest: int, stop: int
) -> PictureMeasurements | None:
    """The stripe on the board, whose pose in the camera is known from a photograph `near`; None when it misses it."""
    assert lit.profile is not None
    assert near.view is not None
    here = from_parts((near.rail_position - lit.rail_position) * state.rail_direction) * pose
    rows = points_on_board(state.camera, here, near.view.spec, lit.profile, near.view.dot_radius)
    if not len(rows):
        return None
    # As fine as in the calibration: neighbouring rows share an error, so its scale holds for means of as many rows.
    stripe, sigma = stripe_means(lit.profile, rows, STRIPE_POINTS)
    data = ViewData(
        points=np.zeros((0, 3)),
        pixels=np.zeros((0, 2)),
        sigma=np.zeros(0),
        dot_radius=0.0,
        stripe=stripe,
        stripe_sigma=sigma,
        base_from_flange=lit.base_from_flange,
        rail=lit.rail_position,
        stripe_axis=1 if lit.profile.axis == "columns" else 0,
    )
    return PictureMeasurements(data, rest, stop, sweeping=True)
