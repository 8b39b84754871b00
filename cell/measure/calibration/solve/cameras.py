"""A camera's calibration from its observations: closed form, joint adjustment, and what refuses the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cell.measure.calibration.judge.board_size import board_size
from cell.measure.calibration.judge.faults import refuse_bent, refuse_exchanged, refuse_slipped
from cell.measure.calibration.judge.joint_checks import joint_checks
from cell.measure.calibration.observations import ScanObservation, TargetObservation
from cell.measure.calibration.solve.adjustment import Adjustment, Priors
from cell.measure.calibration.solve.joint import Joint, Staged, solve_joint, solve_staged
from cell.measure.calibration.solve.results import ScanCalibration, TargetCalibration
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.vision.board.board import board_pose
from drivers.errors import RefusedError


def calibrate_scan(
    observations: Sequence[ScanObservation], nominal: CameraModel, rail_direction: Array, priors: Priors
) -> ScanCalibration:
    """Closed form and joint adjustment; raises `RefusedError` when the observations do not determine it."""
    return ScanCalibration.of(adjust_scan(observations, nominal, rail_direction, priors))


def adjust_scan(
    observations: Sequence[ScanObservation], nominal: CameraModel, rail_direction: Array, priors: Priors
) -> Joint:
    """The joint adjustment of the scan head; observations of one rest share what the arm's repeatability made there."""
    staged = solve_staged(observations, nominal, rail_direction)
    return _solve(observations, staged, priors, camera="scan", board="fine", nominal=nominal)


def calibrate_target(
    observations: Sequence[TargetObservation], nominal: CameraModel, priors: Priors
) -> TargetCalibration:
    """The same for a camera without laser and rail."""
    return TargetCalibration.of(adjust_target(observations, nominal, priors))


def adjust_target(observations: Sequence[TargetObservation], nominal: CameraModel, priors: Priors) -> Joint:
    """The joint adjustment of a camera without laser and rail."""
    same = [ScanObservation(o.view, None, o.base_from_flange, 0.0, o.name) for o in observations]
    return _solve(same, solve_staged(same, nominal, stripe=False), priors, "target", board="large", nominal=nominal)


def _solve(
    observations: Sequence[ScanObservation],
    staged: Staged,
    priors: Priors,
    camera: str,
    board: str,
    nominal: CameraModel,
) -> Joint:
    """The joint adjustment, after and before the checks for faults that have a name, and the absolute ones."""
    rests = [o for o in observations if not o.same_rest]
    names = [o.name for o in rests]
    if all(o.view is not None for o in rests):
        refuse_exchanged(names, [o.base_from_flange for o in rests], staged.camera_from_board)
    joint = solve_joint(observations, staged, priors)
    refuse_bent(board, joint.adjusted, joint.views)
    seen = [o.view for o in rests if o.view is not None]
    if len(seen) == len(rests):
        poses = [board_pose(view, joint.adjusted.state.camera).camera_from_board for view in seen]
        alone = [view for view in joint.views if not view.same_rest]
        refuse_slipped(camera, names, joint.adjusted, alone, poses)
    pitch = next(o.view.spec.pitch for o in observations if o.view is not None)
    problem = Adjustment(joint.views, joint.free, joint.adjusted.priors)
    size = board_size(board, pitch, problem, joint.adjusted)
    size.require()
    wrong = [check.text for check in joint_checks(joint, nominal) if check.verdict == "refused"]
    if wrong:
        raise RefusedError(f"the {camera} camera's calibration: {'; '.join(wrong)}")
    return replace(joint, adjusted=size.allowed_for(joint.adjusted), size=size)
