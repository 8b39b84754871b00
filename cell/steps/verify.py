"""Verifying the calibration: one view of each deck board, approached several times, and one sweep over the fine board.

The views are the calibration's own, aimed with what it found: near enough to its poses that the arm's kinematic error
is the same. Approaching them anew averages the arm's repeatability. In each approach the scan camera photographs its
board from both ends of the way that the rail can go with the board in view.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from cell.assembly import Devices
from cell.calibration import ScanObservation, TargetObservation
from cell.calibration.place_effect import scan_effect, target_effect
from cell.calibration.results import PARAMETERS
from cell.calibration.verification import FALSE_ALARMS, WORST_FIT, Suspect, Verdict
from cell.calibration.verification_looks import CheckObservations, verify
from cell.config import CellConfig
from cell.geometry.poses import from_parts, from_ur
from cell.job import Job, ScanSection
from cell.planning import ScanPlan, View, centre_of, rail_ends, verification_views
from cell.reconstruction import ScanGeometry
from cell.steps.collect import PHOTO_RATE, Check, Progress, move_to_view
from cell.steps.moves import HOME, Mover
from cell.steps.rail_sweep import rail_sweep
from cell.steps.swath import Collector, SweepErrors
from cell.stored_calibration import CellCalibration
from cell.vision import BoardSpec, BoardView, StripeProfile, find_board, parse_board
from drivers.errors import RefusedError
from drivers.interfaces import Camera

SCAN_APPROACHES, TARGET_APPROACHES = 2, 6
BACK_M = 0.02
"""How far the flange leaves a view, each time another way, before it approaches it again."""
SWEEP_SPEED, SWEEP_RATE = "12 mm/s", "10 Hz"


@dataclass(frozen=True, eq=False)
class Verification:
    """The verdict with its expected effect on the place: `effects` in m, in the order of `verdict.suspects`."""

    verdict: Verdict
    effects: list[float]
    date: str

    @classmethod
    def of(cls, calibration: CellCalibration, job: Job, seen: CheckObservations) -> Verification:
        """Compare what was seen with the calibration, and reckon the effect for a job."""
        verdict = verify(calibration.scan, calibration.target, seen)
        board = parse_board(job.board.spec)
        camera_from_board = from_parts((0.0, 0.0, job.photo.stand_off)) * from_parts(-centre_of(board))
        place = (camera_from_board * job.place_from_board.inverse()).translation

        def effect(suspect: Suspect) -> float:
            if suspect.chain == "target":
                return target_effect(calibration.target, suspect.change, place)
            # A sweep has the middle of the rail's travel in its middle; where that is, a direction's error is taken up.
            half = 0.5 * job.scan.length
            return scan_effect(calibration.scan, suspect.change, job.scan.stand_off, (-half, half))

        return cls(verdict, [effect(suspect) for suspect in verdict.suspects], calibration.date)

    @property
    def good(self) -> bool:
        """True when nothing speaks for a change."""
        return self.verdict.good

    @property
    def reason(self) -> str:
        """The decision in words, and the next step."""
        v = self.verdict
        if v.good:
            return (
                f"the calibration of {self.date} is good: nothing speaks for a change (log odds {v.statistic:.1f}, "
                f"chance reaches {v.threshold:.1f} in {FALSE_ALARMS:.0%} of checks)"
            )
        if v.statistic <= v.threshold:
            worst = "; ".join(f"{kind} {v.fit[kind]:.1f} times" for kind in v.badly_fitting)
            return (
                f"the observations fit worse than when the calibration of {self.date} was made, and no moved part "
                f"explains it: {worst} the residuals of then, allowed {WORST_FIT:g}; see whether the boards are clean "
                "and flat and the lenses in focus, then run `cell calibrate`"
            )
        named = " or ".join(
            f"the {s.part}{_DECK.get(s.part, '')} ({s.probability:.0%}, {1e3 * effect:.2f} mm)"
            for s, effect in zip(v.suspects, self.effects, strict=True)
        )
        return (
            f"the calibration of {self.date} is not good any more (log odds {v.statistic:.1f}, allowed "
            f"{v.threshold:.1f}): suspected is {named}, in brackets its probability and the place error to expect; "
            "fasten what is loose, then run `cell calibrate`"
        )

    def summary(self) -> dict[str, Any]:
        """For reports, units in the names."""
        v = self.verdict
        return {
            "good": v.good,
            "reason": self.reason,
            "calibration_date": self.date,
            "log_odds": round(v.statistic, 3),
            "log_odds_allowed": round(v.threshold, 3),
            "residuals_over_calibration": {kind: round(value, 3) for kind, value in v.fit.items()},
            "residuals_allowed": WORST_FIT,
            "suspects": [
                {
                    "part": s.part,
                    "probability": round(s.probability, 3),
                    "change": _named(s.change),
                    "place_error_mm": round(1e3 * effect, 4),
                }
                for s, effect in zip(v.suspects, self.effects, strict=True)
            ]
            if not v.good
            else [],
            "figures": [
                {"name": f.name, "value": round(f.value, 5), "sigma": round(f.sigma, 5), "unit": f.unit}
                for f in v.figures
            ],
        }


_DECK = {
    "scan camera's mount on the flange": ", or the fine board on the deck",
    "target camera's mount on the flange": ", or the large board on the deck",
}


def _named(change: np.ndarray) -> dict[str, float]:
    """The parameters that change, px or relative as they are, m as mm and rad as mrad."""
    made = {}
    for k, name in enumerate(PARAMETERS):
        if change[k] == 0.0:
            continue
        plain = name[0] in "fck"
        unit = "" if plain else "_per_mille" if name.startswith("rail") else "_mrad" if _angle(name) else "_mm"
        made[name.replace(" ", "_") + (unit or "_px")] = round(float(change[k]) * (1.0 if plain else 1e3), 4)
    return made


def _angle(name: str) -> bool:
    return "tilt" in name or name.split()[-1] in ("rx", "ry", "rz")


def collect_verification(
    config: CellConfig, devices: Devices, mover: Mover, calibration: CellCalibration, check: Check, progress: Progress
) -> CheckObservations:
    """Take all pictures. Raises `RefusedError` when a board is not seen, `CalibrationStale` without a reference."""
    fine, large = parse_board(config.calibration.fine.board), parse_board(config.calibration.large.board)
    scan_view, target_view = verification_views(config, fine, large, calibration.scan, calibration.target)
    assert calibration.scan.reference is not None
    base_from_board = calibration.scan.reference.base_from_board
    ends = rail_ends(calibration.scan, base_from_board, scan_view, fine, config.rail.travel)
    if not devices.rail.state().homed:
        progress(0.0, "homing the rail")
        devices.rail.home().wait(60.0)
    mover.to_joints(HOME)
    photographs: list[list[ScanObservation]] = []
    sweep: list[ScanObservation] = []
    for k in range(SCAN_APPROACHES):
        check()
        progress(0.6 * k / SCAN_APPROACHES, f"fine board, approach {k + 1} of {SCAN_APPROACHES}")
        if k:
            move_to_view(devices, mover, _beside(scan_view, k), k)
        if k == SCAN_APPROACHES - 1:
            sweep = _sweep(
                config,
                devices,
                mover,
                calibration.scan.geometry(),
                scan_view,
                ends,
                lambda f, t: progress(0.3 + 0.2 * f, t),
            )
        else:
            move_to_view(devices, mover, scan_view, k)
        photographs.append(_photographs(config, devices, fine, ends))
    target: list[TargetObservation] = []
    devices.target_camera.configure(config.target_camera.photo_exposure, PHOTO_RATE)
    for k in range(TARGET_APPROACHES):
        check()
        progress(0.6 + 0.4 * k / TARGET_APPROACHES, f"large board, approach {k + 1} of {TARGET_APPROACHES}")
        if k:
            move_to_view(devices, mover, _beside(target_view, k), k)
        move_to_view(devices, mover, target_view, k)
        seen = _found(devices.target_camera, large, "large")
        target.append(TargetObservation(seen, from_ur(devices.arm.state().flange), f"large {k + 1}"))
    return CheckObservations(photographs, sweep, target)


def _photographs(
    config: CellConfig, devices: Devices, board: BoardSpec, ends: tuple[float, float]
) -> list[ScanObservation]:
    devices.scan_camera.configure(config.scan_camera.photo_exposure, PHOTO_RATE)
    made = []
    for end in ends:
        devices.rail.move_to(end).wait(30.0)
        seen = _found(devices.scan_camera, board, "fine")
        flange = from_ur(devices.arm.state().flange)
        made.append(ScanObservation(seen, None, flange, devices.rail.state().position))
    return made


def _sweep(
    config: CellConfig,
    devices: Devices,
    mover: Mover,
    geometry: ScanGeometry,
    view: View,
    ends: tuple[float, float],
    progress: Callable[[float, str], None],
) -> list[ScanObservation]:
    """To the view and over the board's plate from end to end."""
    section = ScanSection.model_validate(
        {
            "stand_off": "130 mm",
            "length": f"{1e3 * (ends[1] - ends[0])} mm",
            "speed": SWEEP_SPEED,
            "frame_rate": SWEEP_RATE,
            "exposure": f"{1e3 * config.calibration.stripe_exposure} ms",
        }
    )
    profiles: list[StripeProfile] = []
    plan = ScanPlan(view.base_from_flange, view.base_from_flange, *ends)
    errors = SweepErrors(np.zeros((6, 6)), config.calibration.rail_sigma, devices.clock.rate)
    collector = Collector(geometry, section, lambda _: None, progress, profiles.append)
    swath = rail_sweep(plan, mover, devices, errors, collector)
    return [
        ScanObservation(None, profiles[line], swath.base_from_flange, float(position))
        for line, position in zip(swath.lines, swath.rail, strict=True)
    ]


def _found(camera: Camera, board: BoardSpec, name: str) -> BoardView:
    try:
        return find_board(camera.grab().image, board)
    except RefusedError as error:
        raise RefusedError(
            f"the {name} board on the deck is not seen where the calibration has it: {error}; clean it, see that it "
            "and the camera are in place, then run `cell calibrate`"
        ) from error


def _beside(view: View, turn: int) -> View:
    """A pose near a view, up and to another side each time."""
    side = 2.4 * turn
    away = np.array([BACK_M * np.cos(side), BACK_M * np.sin(side), BACK_M])
    moved = pin.SE3(view.base_from_flange.rotation, view.base_from_flange.translation + away)
    return View(moved, view.rail_position)
