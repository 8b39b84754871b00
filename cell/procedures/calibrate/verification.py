"""Verifying a stored calibration: pictures of both deck boards and a sweep, and the verdict in words and numbers.

The views are the calibration's own, so that the arm's kinematic error is the same; approaching them anew averages the
arm's repeatability. What the board shows of the laser is kept with the calibration: a job has only the plate on the
claw, which may have been knocked. The decision is `cell.measure.calibration.drift.decision`'s.
"""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pinocchio as pin

from cell.config.calibrations.store import CellCalibration, save_calibration
from cell.config.cell_config import CellConfig
from cell.config.job import Job, ScanSection
from cell.devices.devices import Devices
from cell.measure.calibration import ScanObservation, TargetObservation
from cell.measure.calibration.drift.decision import (
    DETECTED,
    WORST_FIT,
    DriftVerdict,
    Suspect,
    scan_effect,
    target_effect,
    verdict,
)
from cell.measure.calibration.drift.evidence import (
    CHECKED_LARGE_VIEW,
    CHECKED_VIEW,
    PictureMeasurements,
    dots_of,
    evidence,
)
from cell.measure.calibration.drift.reference_plate import ConfirmedTurn, Pointing, turn_seen
from cell.measure.calibration.drift.slip import WitnessCheck
from cell.measure.calibration.solve.joint import STRIPE_POINTS
from cell.measure.calibration.solve.normal import AdjustmentState, ViewData
from cell.measure.calibration.solve.results import ScanCalibration, TargetCalibration
from cell.measure.calibration.solve.starts import stripe_means
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import from_parts, from_ur
from cell.measure.reconstruction.build import ScanGeometry
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.board.view import BoardSpec, BoardView, centre_of, parse_board
from cell.measure.vision.stripe.profile import StripeProfile
from cell.measure.vision.stripe_on_board import points_on_board
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import Mover
from cell.procedures.arm.photograph import CalibrationView, ScanPlan, rail_ends, references, verification_views
from cell.procedures.calibrate.boards import PHOTO_RATE, Check, Keep, Progress, look_for, move_to_view
from cell.procedures.calibrate.reference_plate import ROOM_M, require_reference_plate
from cell.procedures.frame_store import Cut
from cell.procedures.sweep.swath import SweepCollector, SweepErrors, warm_up
from cell.procedures.sweep.sweeping import home_rail, rail_sweep
from drivers.errors import RefusedError
from drivers.interfaces import Camera, Frame

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
    """Compare with what the calibration predicts. Raises `CalibrationStale` for a calibration that was stored without
    its reference, `RefusedError` when the sweep does not show the board."""
    near, far = references(scan, target)
    head, eye = scan.state(near.base_from_board), target.state(far.base_from_board)
    evidences = {
        "scan": evidence(head, near, scan_looks(head, seen), CHECKED_VIEW),
        "target": evidence(eye, far, target_looks(seen.target), CHECKED_LARGE_VIEW),
    }
    return verdict(evidences, {"scan": head, "target": eye})


def check_witness(scan: ScanCalibration, seen: CheckObservations) -> WitnessCheck | None:
    """What the board says to the laser's pointing by its witness; None without one. Raises what `verify` raises."""
    if seen.pointing is None or scan.reference is None:
        return None
    state = scan.state(scan.reference.base_from_board)
    weighed = evidence(state, scan.reference, scan_looks(state, seen), CHECKED_VIEW)
    return WitnessCheck.of(seen.pointing, seen.exit_point, state, weighed)


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
        points=np.zeros((0, 3)), pixels=np.zeros((0, 2)), sigma=np.zeros(0), dot_radius=0.0, stripe=stripe,
        stripe_sigma=sigma, base_from_flange=lit.base_from_flange, rail=lit.rail_position,
        stripe_axis=1 if lit.profile.axis == "columns" else 0,
    )  # fmt: skip
    return PictureMeasurements(data, rest, stop, sweeping=True)


SCAN_APPROACHES, TARGET_APPROACHES = 2, 6
BACK_M = 0.02
"""How far the flange leaves a view, each time another way, before it approaches it again."""
SWEEP_SPEED, SWEEP_RATE = 0.012, "10 Hz"
"""The speed in m/s, where the rail can go as fast."""
MAX_SHIFT = 0.15e-3
"""Farthest, in m, that the sweep may lie off because of its times: less than the changes that are looked for."""


def collect_verification(
    config: CellConfig, devices: Devices, mover: Mover, calibration: CellCalibration, check: Check,
    progress: Progress, keep: Keep,
) -> CheckObservations:  # fmt: skip
    """Take all pictures; each goes to `keep`. Raises `RefusedError` when a board or the laser's witness is not seen,
    `CalibrationStale` without a reference."""
    fine, large = parse_board(config.calibration.fine.board), parse_board(config.calibration.large.board)
    scan_view, target_view = verification_views(config, fine, large, calibration.scan, calibration.target)
    near, _ = references(calibration.scan, calibration.target)
    room = SWEEP_SPEED**2 / (2 * config.rail.acceleration) + ROOM_M
    low, high = config.rail.travel
    ends = rail_ends(calibration.scan, near.base_from_board, scan_view, fine, (low + room, high - room))
    home_rail(devices, progress)
    mover.to_joints(HOME)
    pointing = None
    if calibration.scan.witness is not None:
        progress(0.0, "looking where the laser points")
        head, now = calibration.scan, require_reference_plate(config, devices, keep)
        pointing = turn_seen(calibration.scan.witness, now, head.camera, head.light_plane, config.laser.exit_point)
    photographs: list[list[ScanObservation]] = []
    sweep: list[ScanObservation] = []
    for k in range(SCAN_APPROACHES):
        check()
        progress(0.6 * k / SCAN_APPROACHES, f"fine board, approach {k + 1} of {SCAN_APPROACHES}")
        if k:
            move_to_view(devices, mover, _beside(scan_view, k), k)
        if k == SCAN_APPROACHES - 1:
            sweep = _sweep(
                config, devices, mover, geometry=calibration.scan.geometry(), view=scan_view, ends=ends,
                progress=lambda f, t: progress(0.3 + 0.2 * f, t), keep_frame=lambda frame, cut: keep("stripe", frame),
            )  # fmt: skip
        else:
            move_to_view(devices, mover, scan_view, k)
        photographs.append(_photographs(config, devices, fine, ends=ends, keep=keep, what=f"fine-{k + 1}"))
    target: list[TargetObservation] = []
    devices.target_camera.configure(config.target_camera.photo_exposure, PHOTO_RATE)
    for k in range(TARGET_APPROACHES):
        check()
        progress(0.6 + 0.4 * k / TARGET_APPROACHES, f"large board, approach {k + 1} of {TARGET_APPROACHES}")
        if k:
            move_to_view(devices, mover, _beside(target_view, k), k)
        move_to_view(devices, mover, target_view, k)
        seen = _found(devices.target_camera, large, "large", keep, f"large-{k + 1}")
        target.append(TargetObservation(seen, from_ur(devices.arm.state().flange), f"large {k + 1}"))
    return CheckObservations(photographs, sweep, target, pointing, config.laser.exit_point)


def _photographs(
    config: CellConfig, devices: Devices, board: BoardSpec, ends: tuple[float, float], keep: Keep, what: str
) -> list[ScanObservation]:
    devices.scan_camera.configure(config.scan_camera.photo_exposure, PHOTO_RATE)
    made = []
    for end, side in zip(ends, "ab", strict=True):
        devices.rail.move_to(end).wait(30.0)
        seen = _found(devices.scan_camera, board, "fine", keep, what + side)
        flange = from_ur(devices.arm.state().flange)
        made.append(ScanObservation(seen, None, flange, devices.rail.state().position))
    return made


def _sweep(
    config: CellConfig, devices: Devices, mover: Mover, geometry: ScanGeometry, view: CalibrationView,
    ends: tuple[float, float], progress: Callable[[float, str], None], keep_frame: Callable[[Frame, Cut | None], None],
) -> list[ScanObservation]:  # fmt: skip
    """To the view and over the board's plate from end to end."""
    length, exposure = f"{1e3 * (ends[1] - ends[0])} mm", f"{1e3 * config.calibration.stripe_exposure} ms"
    speed = f"{1e3 * min(SWEEP_SPEED, config.rail.max_speed)} mm/s"
    section = ScanSection.model_validate({
        "stand_off": "130 mm", "length": length, "speed": speed, "frame_rate": SWEEP_RATE, "exposure": exposure,
    })  # fmt: skip
    profiles: list[StripeProfile] = []
    plan = ScanPlan(view.base_from_flange, view.base_from_flange, *ends)
    errors = SweepErrors(np.zeros((6, 6)), config.calibration.rail_sigma, MAX_SHIFT, devices.clock.rate)
    collector = SweepCollector(geometry, section, keep_frame, progress, profiles.append)
    warm_up(geometry)
    swath = rail_sweep(plan, mover, devices, errors, collector)
    return [
        ScanObservation(None, profiles[line], swath.base_from_flange, float(position))
        for line, position in zip(swath.lines, swath.rail, strict=True)
    ]


def _found(camera: Camera, board: BoardSpec, name: str, keep: Keep, what: str) -> BoardView:
    refusals = Counter[str]()
    seen = look_for(camera, board, refusals, keep, what)
    if seen is None:
        raise RefusedError(
            f"the {name} board on the deck is not seen where the calibration has it: {next(iter(refusals))}; clean it, "
            "see that it and the camera are in place, then run `cell calibrate`"
        )
    return seen


def _beside(view: CalibrationView, turn: int) -> CalibrationView:
    """A pose near a view, up and to another side each time."""
    side = 2.4 * turn
    away = np.array([BACK_M * np.cos(side), BACK_M * np.sin(side), BACK_M])
    moved = pin.SE3(view.base_from_flange.rotation, view.base_from_flange.translation + away)
    return CalibrationView(moved, view.rail_position)


SHARE = 0.3
"""Of the place's tolerance: what moves the place by less is told and not called bad. A third, with room for an estimate
that falls a little short."""
SURE = 0.95
"""How sure a change's effect is below what is stated as the most."""
DRAWS = 100


@dataclass(frozen=True, eq=False)
class Verification:
    """The verdict, and what it means at the place of a job, lengths in m.

    `effects` are what the suspects' changes do there, `at_most` what they do in `SURE` of cases, both in the order of
    `verdict.suspects`. `unseen` is what a change does that just fails to show, in the order of `verdict.detectable`.
    `witness` is what the board says to the laser's witness, None without one, and `misled` what a job is off by that
    believes the witness. A turn of the laser that both see is no change of the calibration, for jobs allow for it.
    """

    verdict: DriftVerdict
    effects: list[float]
    at_most: list[float]
    unseen: list[float]
    tolerance: float
    date: str
    witness: WitnessCheck | None = None
    misled: float = 0.0

    @classmethod
    def of(cls, calibration: CellCalibration, job: Job, seen: CheckObservations) -> Self:
        """Compare what was seen with the calibration, and reckon the effect for a job."""
        scan, effect = calibration.scan, at_place(calibration, job)
        witness = check_witness(scan, seen)
        if witness is not None and witness.corrects:
            scan = scan.pointed(witness.plate, seen.exit_point)
        verdict = verify(scan, calibration.target, seen)

        def at_most(suspect: Suspect) -> float:
            drawn = np.random.default_rng(0).normal(size=(DRAWS, suspect.spread.shape[1])) @ suspect.spread.T
            return float(np.quantile([effect(suspect.chain, suspect.change + step) for step in drawn], SURE))

        unseen = [effect(d.change.chain, d.step) if np.isfinite(d.size) else np.inf for d in verdict.detectable]
        return cls(
            verdict, [effect(suspect.chain, suspect.change) for suspect in verdict.suspects],
            [at_most(suspect) for suspect in verdict.suspects], unseen=unseen, tolerance=job.place.tolerance,
            date=calibration.date, witness=witness, misled=0.0 if witness is None else effect("scan", witness.wrong),
        )  # fmt: skip

    def __str__(self) -> str:
        return self.reason

    def __repr__(self) -> str:
        return f"<Verification of the calibration of {self.date}: {self.word}>"

    @property
    def hidden(self) -> float:
        """The most that a change of one part does at the place, m, when it just fails to show."""
        return max(self.unseen)

    @property
    def matters(self) -> bool:
        """Whether what changed may move the place by a `SHARE` of its tolerance or more."""
        most: dict[int, float] = {}
        for suspect, does in zip(self.verdict.suspects, self.at_most, strict=True):
            most[suspect.round] = max(does, most.get(suspect.round, 0.0))
        return self.verdict.changed and sum(most.values()) >= SHARE * self.tolerance

    @property
    def good(self) -> bool:
        """True when nothing speaks for a change, or for one that does too little to the place to matter."""
        return not self.matters and not self.verdict.badly_fitting and not self.plate_moved

    @property
    def plate_moved(self) -> bool:
        """Whether the laser's witness, which jobs believe, was knocked."""
        return self.witness is not None and self.witness.plate_moved

    @property
    def word(self) -> str:
        """The verdict in a word or two."""
        if not self.good:
            return "not good any more"
        return "good, slightly changed" if self.verdict.changed else "good"

    @property
    def reason(self) -> str:
        """The decision in words, in mm at the place, and the next step."""
        if self.witness is None or not (self.plate_moved or self.witness.corrects):
            return self._decision
        if self.witness.corrects:
            by_board = self.good and self.witness.confirmation(0.0) is not None
            how = "by the board's figure, which is kept with the calibration" if by_board else "by the plate's"
            return f"{self._decision}. The laser has turned, {self.witness.words}: jobs allow for it {how}"
        return (
            "the plate on the claw that shows where the laser points (laser.witness) has moved, not the laser: "
            f"it has turned {self.witness.words}, and jobs that believe the plate put the place "
            f"{1e3 * self.misled:.2f} mm off. Fasten the plate, then run `cell calibrate`. Apart from it, "
            f"{self._decision}"
        )

    @property
    def _decision(self) -> str:
        v, allowed = self.verdict, f"{1e3 * self.tolerance:.2f} mm"
        if v.changed and (self.matters or not v.badly_fitting):
            rounds: dict[int, list[str]] = {}
            for s, effect, most in zip(v.suspects, self.effects, self.at_most, strict=True):
                does = f"place off by {1e3 * effect:.2f} mm, at most {1e3 * most:.2f} mm"
                rounds.setdefault(s.round, []).append(
                    f"the {s.part}{_DECK.get(s.part, '')} ({s.probability:.0%}): {does}"
                )
            named = "; and as well ".join(" or ".join(words) for words in rounds.values())
            if self.matters:
                return (
                    f"the calibration of {self.date} is not good any more. Changed has {named}; allowed at the place "
                    f"are {allowed}. Fasten what is loose, then run `cell calibrate`"
                )
            return (
                f"the calibration of {self.date} is good, though something seems to have changed a little: {named}; "
                f"allowed at the place are {allowed}. Nothing has to be done now; run `cell calibrate` when there is "
                "time"
            )
        if v.badly_fitting:
            worst = "; ".join(f"{kind} {v.fit[kind]:.1f} times" for kind in v.badly_fitting)
            return (
                f"the calibration of {self.date} is not good any more: the pictures fit worse than when it was made, "
                f"and no moved part explains it: {worst} the residuals of then, allowed {WORST_FIT:g}. See whether the "
                "boards are clean and flat and the lenses in focus, then run `cell calibrate`"
            )
        text = f"the calibration of {self.date} is good: nothing has changed that shows"
        if np.isfinite(self.hidden):
            text += (
                f", and what moves the place by more than {1e3 * self.hidden:.2f} mm would have shown in "
                f"{DETECTED:.0%} of checks like this one (allowed at the place are {allowed})"
            )
        hiding = [
            f"{d.change.part}, {d.change.kind} ({d.words}, {_way(effect)} at the place)"
            for d, effect in zip(v.detectable, self.unseen, strict=True)
            if effect >= SHARE * self.tolerance
        ]
        if not hiding:
            return f"{text}. Go on working"
        return f"{text}. Go on working, but know what could do that unseen: {'; '.join(hiding)}"

    def summary(self) -> dict[str, Any]:
        """For reports, units in the names."""
        v = self.verdict
        return {
            "good": self.good,
            "verdict": self.word,
            "reason": self.reason,
            "calibration_date": self.date,
            "place": {
                "allowed_mm": round(1e3 * self.tolerance, 4),
                "error_mm": round(1e3 * max(self.effects), 4) if v.changed else None,
                "error_at_most_mm": round(1e3 * max(self.at_most), 4) if v.changed else None,
                "shows_from_mm": round(1e3 * self.hidden, 4) if np.isfinite(self.hidden) else None,
            },
            "witness": None if self.witness is None else self.witness.as_dict(),
            "log_odds": round(v.statistic, 3),
            "log_odds_allowed": round(v.threshold, 3),
            "residuals_over_calibration": {kind: round(value, 3) for kind, value in v.fit.items()},
            "residuals_allowed": WORST_FIT,
            "suspects": [
                {
                    **s.as_dict(),
                    "place_error_mm": round(1e3 * effect, 4),
                    "place_error_at_most_mm": round(1e3 * most, 4),
                }
                for s, effect, most in zip(v.suspects, self.effects, self.at_most, strict=True)
            ]
            if v.changed
            else [],
            "detectable_share": DETECTED,
            "detectable": [d.as_dict() for d in v.detectable],
            "figures": [f.as_dict() for f in v.figures],
        }


def at_place(calibration: CellCalibration, job: Job, middle: float = 0.0) -> Callable[[str, Array], float]:
    """What a change (27,) of the "scan" or the "target" chain does at the place of a job, m. `middle` is where the rail
    stands in the middle of a sweep, for a change that turns the rail as well."""
    board = parse_board(job.board.spec)
    camera_from_board = from_parts((0.0, 0.0, job.photo.stand_off)) * from_parts(-centre_of(board))
    place = (camera_from_board * job.place_from_board.inverse()).translation

    # A sweep has the middle of the rail's travel in its middle; where that is, a direction's error is taken up.
    half = 0.5 * job.scan.length
    of_scan = scan_effect(calibration.scan, job.scan.stand_off, (middle - half, middle + half))

    def effect(chain: str, change: Array) -> float:
        return target_effect(calibration.target, change, place) if chain == "target" else of_scan(change)

    return effect


_DECK = {
    "scan camera's mount on the flange": ", or the fine board on the deck",
    "target camera's mount on the flange": ", or the large board on the deck",
}


def _way(effect: float) -> str:
    return f"{1e3 * effect:.2f} mm" if np.isfinite(effect) else "any amount"


def keep_confirmed(folder: Path, calibration: CellCalibration, verification: Verification) -> ConfirmedTurn | None:
    """Keep what `verification` says of the laser with the `calibration` stored in `folder`; what is newly kept.

    A verification that finds anything wrong confirms nothing, and what an earlier one had confirmed goes: the plate by
    which jobs would carry it on may have been knocked since, and so may the laser.
    """
    witness, known = verification.witness, calibration.scan.confirmed
    if witness is None:
        return None
    found = witness.confirmation(time.time()) if verification.good else None
    # Good, and the laser as at the calibration: an earlier turn is as true as it was.
    kept = found if found is not None or not verification.good else known
    if kept is not known:
        changed = replace(calibration, scan=replace(calibration.scan, confirmed=kept))
        save_calibration(changed, folder / f"{calibration.name}.json")
    return found
