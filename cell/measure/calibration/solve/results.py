"""A camera's calibration from its observations, and what it gives, for scan head and target camera."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self, TypeVar

import numpy as np
import pinocchio as pin

from cell.measure.calibration.archive import ScanObservation, TargetObservation
from cell.measure.calibration.drift.evidence import Reference
from cell.measure.calibration.drift.reference_plate import ConfirmedTurn, PlateLine, Pointing, rolled, turned
from cell.measure.calibration.drift.timing import Shutter, StampTiming
from cell.measure.calibration.judge.checks import joint_checks
from cell.measure.calibration.judge.faults import refuse_bent, refuse_exchanged, refuse_slipped
from cell.measure.calibration.judge.scale import board_size
from cell.measure.calibration.solve.adjustment import Adjustment, Priors
from cell.measure.calibration.solve.bow import FLAT
from cell.measure.calibration.solve.joint import Joint, Staged, effective_hand_eye_covariance, solve_joint, solve_staged
from cell.measure.calibration.solve.normal import HAND, SHARED, AdjustmentState
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import covariance_root, from_matrix, from_parts
from cell.measure.reconstruction.build import ScanGeometry
from cell.measure.vision.board.board import board_pose
from drivers.errors import RefusedError

PARAMETERS = (
    "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "plane tilt a", "plane tilt b", "plane distance",
    "rail x", "rail y", "rail z", "hand-eye x", "hand-eye y", "hand-eye z", "hand-eye rx", "hand-eye ry", "hand-eye rz",
)  # fmt: skip
"""Names of the parameters that a calibration keeps the covariance of, in its order; px, 1, m and rad."""

KEPT = HAND.stop
Found = TypeVar("Found")


@dataclass(frozen=True)
class Quality:
    """How well the observations fit. Held-out figures predict every fourth view from the others, at the flange poses as
    reported; `stripe` in m is the distance of the triangulated stripe from the board's plane, None without a laser."""

    views: int
    chi2_per_dof: float
    dots_rms_px: float
    stripe_rms: float | None
    held_out_px: float
    held_out_stripe: float | None

    @classmethod
    def of(cls, joint: Joint) -> Self:
        """The figures of a joint adjustment."""
        a = joint.adjusted
        lit = a.state.plane is not None
        stripe, held_out = (a.stripe_rms_m, joint.held_out_stripe_m) if lit else (None, None)
        return cls(len(joint.views), a.chi2_per_dof, a.dots_rms_px, stripe, joint.held_out_px, held_out_stripe=held_out)


@dataclass(frozen=True, eq=False)
class ScanCalibration:
    """The scan head: camera, light plane in the camera's frame, rail and hand-eye.

    `rail_direction` (3,): metres that the camera moves, in its own axes, per metre of rail reading (direction times
    scale). `flange_from_camera` holds at rail position 0. `covariance` (21, 21) in the order of `PARAMETERS`; the light
    plane's tilts are about the tangents of `cell.measure.calibration.solve.normal.tangents`, the hand-eye's are
    (translation, rotation) in flange axes. `reference` is what a verification compares with; files of older programs
    have none. `bow_sigma` is one standard deviation of the sheet's bow, 0 where it is taken as flat, and `bow_gain`
    (21,) how the other parameters follow the bow; `covariance` has that in it. `notes` are for people: what is not as
    usual. With a `pointing` the light plane is the one that the `witness` showed later, turned about `exit_point` (3,),
    m, in the camera's frame. `confirmed` is what a verification found out about the laser since, `timing` how late the
    camera's time stamps were found to come, `shutter` how its rows are exposed; `unread` says what of these a file held
    that cannot be read, `refused` why a later look at the camera's times was refused, "" if none was.
    """

    camera: CameraModel
    light_plane: LightPlane
    rail_direction: Array
    flange_from_camera: pin.SE3
    covariance: Array
    quality: Quality
    reference: Reference | None = None
    bow_sigma: float = 0.0
    bow_gain: Array = field(default_factory=lambda: np.zeros(KEPT))
    notes: tuple[str, ...] = ()
    witness: PlateLine | None = None
    pointing: Pointing | None = None
    exit_point: Array = field(default_factory=lambda: np.zeros(3))
    confirmed: ConfirmedTurn | None = None
    timing: StampTiming | None = None
    shutter: Shutter | None = None
    unread: tuple[str, ...] = ()
    refused: str = ""

    @classmethod
    def of(cls, joint: Joint) -> Self:
        """What a joint adjustment with a stripe found."""
        state, reference, bow = joint.adjusted.state, Reference.of(joint.adjusted), joint.adjusted.bow or FLAT
        assert state.plane is not None
        return cls(
            state.camera, state.plane, state.rail_direction, flange_from_camera=state.flange_from_camera,
            covariance=reference.covariance[:KEPT, :KEPT], quality=Quality.of(joint), reference=reference,
            bow_sigma=bow.sigma * joint.adjusted.inflation, bow_gain=bow.gain[:KEPT],
            notes=(*((bow.words,) if bow.sigma else ()), *(joint.size.notes if joint.size else ())),
        )  # fmt: skip

    def flange_from_camera_at(self, rail_position: float) -> pin.SE3:
        """The camera's pose in the flange frame at a rail position in m."""
        return self.flange_from_camera * from_parts(rail_position * self.rail_direction)

    def state(self, base_from_board: pin.SE3) -> AdjustmentState:
        """As an adjustment knows it, with the board there."""
        return AdjustmentState(
            self.camera, self.light_plane, self.rail_direction, self.flange_from_camera, base_from_board
        )

    def geometry(self) -> ScanGeometry:
        """What triangulation needs."""
        return ScanGeometry(self.camera, self.light_plane, self.rail_direction, self.flange_from_camera)

    def pointed(self, pointing: Pointing, exit_point: Array) -> Self:
        """With the light plane as the laser points now; `exit_point` (3,) of the laser in m, camera frame, as drawn."""
        plane = rolled(turned(self.light_plane, exit_point, pointing.turn), exit_point, pointing.roll)
        return replace(self, light_plane=plane, pointing=pointing, exit_point=exit_point)

    def variants(self) -> list[ScanGeometry]:
        """The geometry moved by one standard deviation along each independent direction of the covariance."""
        state = self.state(pin.SE3.Identity())
        made = []
        by_bow = self.bow_sigma * self.bow_gain
        steps = list(covariance_root(self.covariance - np.outer(by_bow, by_bow)).T)
        bows = [self.light_plane.bow] * len(steps)
        if self.bow_sigma:
            steps.append(by_bow)
            bows.append(self.light_plane.bow + self.bow_sigma)
        for step, bow in zip(steps, bows, strict=True):
            moved = replace(state, plane=self.light_plane.bowed(bow)).moved(
                np.concatenate([step, np.zeros(SHARED - KEPT)])
            )
            assert moved.plane is not None
            made.append(ScanGeometry(moved.camera, moved.plane, moved.rail_direction, moved.flange_from_camera))
        if self.pointing is not None:
            plane = turned(self.light_plane, self.exit_point, self.pointing.sigma)
            made.append(replace(self.geometry(), light_plane=plane))
            if self.pointing.roll_sigma:
                plane = rolled(self.light_plane, self.exit_point, self.pointing.roll_sigma)
                made.append(replace(self.geometry(), light_plane=plane))
        return made

    def as_dict(self) -> dict[str, object]:
        """For storage. What was found out since the calibration has its key only where there is any."""
        found = {"confirmed": self.confirmed, "timing": self.timing, "shutter": self.shutter}
        return {
            **{name: dict(vars(one)) for name, one in found.items() if one is not None},
            **({"refused": self.refused} if self.refused else {}),
            "camera": self.camera.as_dict(),
            "light_plane": {
                "normal": list(self.light_plane.normal),
                "distance": self.light_plane.distance,
                "bow": self.light_plane.bow,
                "bow_sigma": self.bow_sigma,
                "bow_gain": self.bow_gain.tolist(),
            },
            "rail_direction": self.rail_direction.tolist(),
            "flange_from_camera": self.flange_from_camera.homogeneous.tolist(),
            "covariance": self.covariance.tolist(),
            "quality": vars(self.quality),
            "reference": None if self.reference is None else self.reference.as_dict(),
            "notes": list(self.notes),
            "witness": None if self.witness is None else self.witness.as_dict(),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """From storage; KeyError, TypeError or ValueError when it is not one."""
        plane, unread = data["light_plane"], []

        def found(name: str, read: Callable[[Any], Found | None], instead: str) -> Found | None:
            # The calibration holds without it.
            try:
                return read(data.get(name))
            except (KeyError, TypeError, AttributeError, ValueError) as error:
                unread.append(f"the stored calibration's {name} cannot be read ({error!r}) and is left out: {instead}")
                return None

        again = "jobs go on with scan_camera.late until `cell calibrate timing` has measured it again"
        timing = found("timing", StampTiming.read, again)
        shutter = found("shutter", Shutter.read, "run `cell calibrate timing`, which looks at it again")
        alone = "jobs go by the plate on the claw alone until `cell calibrate verify` has seen the laser again"
        confirmed = found("confirmed", ConfirmedTurn.read, alone)
        return cls(
            CameraModel.read(data["camera"]),
            LightPlane.of(plane["normal"], float(plane["distance"])).bowed(float(plane["bow"])),
            np.array(data["rail_direction"], dtype=np.float64),
            flange_from_camera=from_matrix(data["flange_from_camera"]),
            covariance=np.array(data["covariance"], dtype=np.float64).reshape(KEPT, KEPT),
            quality=Quality(**data["quality"]), reference=Reference.read(data.get("reference")),
            bow_sigma=float(plane["bow_sigma"]),
            bow_gain=np.array(plane["bow_gain"], dtype=np.float64).reshape(KEPT),
            notes=tuple(data["notes"]), witness=PlateLine.read(data["witness"]), confirmed=confirmed,
            timing=timing, shutter=shutter, unread=tuple(unread), refused=str(data.get("refused", "")),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class TargetCalibration:
    """The target camera and its hand-eye; `hand_eye_covariance` (6, 6) in flange axes counts for a board seen by it."""

    camera: CameraModel
    flange_from_camera: pin.SE3
    hand_eye_covariance: Array
    quality: Quality
    reference: Reference | None = None

    @classmethod
    def of(cls, joint: Joint) -> Self:
        """What a joint adjustment found."""
        state = joint.adjusted.state
        return cls(
            state.camera, state.flange_from_camera, effective_hand_eye_covariance(joint), Quality.of(joint),
            Reference.of(joint.adjusted),
        )  # fmt: skip

    def state(self, base_from_board: pin.SE3) -> AdjustmentState:
        """As an adjustment knows it, with the board there; no light plane, no rail."""
        return AdjustmentState(self.camera, None, np.zeros(3), self.flange_from_camera, base_from_board)

    def as_dict(self) -> dict[str, object]:
        """For storage."""
        return {
            "camera": self.camera.as_dict(), "flange_from_camera": self.flange_from_camera.homogeneous.tolist(),
            "hand_eye_covariance": self.hand_eye_covariance.tolist(), "quality": vars(self.quality),
            "reference": None if self.reference is None else self.reference.as_dict(),
        }  # fmt: skip

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """From storage; KeyError, TypeError or ValueError when it is not one."""
        return cls(
            CameraModel.read(data["camera"]), from_matrix(data["flange_from_camera"]),
            np.array(data["hand_eye_covariance"], dtype=np.float64).reshape(6, 6), Quality(**data["quality"]),
            Reference.read(data.get("reference")),
        )  # fmt: skip


def sigmas(covariance: Array) -> dict[str, float]:
    """Standard deviations of the scan head's parameters by name."""
    return dict(zip(PARAMETERS, np.sqrt(np.maximum(0.0, np.diag(covariance))).tolist(), strict=True))


def adjust_scan(
    observations: Sequence[ScanObservation], nominal: CameraModel, rail_direction: Array, priors: Priors
) -> Joint:
    """The joint adjustment of the scan head; observations of one rest share what the arm's repeatability made there."""
    staged = solve_staged(observations, nominal, rail_direction)
    return _solve(observations, staged, priors, camera="scan", board="fine", nominal=nominal)


def adjust_target(observations: Sequence[TargetObservation], nominal: CameraModel, priors: Priors) -> Joint:
    """The joint adjustment of a camera without laser and rail."""
    same = [ScanObservation(o.view, None, o.base_from_flange, 0.0, o.name) for o in observations]
    return _solve(same, solve_staged(same, nominal, stripe=False), priors, "target", board="large", nominal=nominal)


def _solve(
    observations: Sequence[ScanObservation], staged: Staged, priors: Priors, camera: str, board: str,
    nominal: CameraModel,
) -> Joint:  # fmt: skip
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
