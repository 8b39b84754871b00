"""How often `cell calibrate verify` finds a disturbed calibration, names its part, and raises a false alarm.

Each seed's world is calibrated from synthetic observations and then looked at again, as it was and with one part moved
by 0.2 mm or 0.05°. The observations are `cell.bench.observed_cell`'s: the simulator's optics, arm and deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cell.bench.observed_cell import ObservedCell, Truth
from cell.calibration import ScanObservation, TargetObservation
from cell.calibration.verification import SCAN_DEPTH, SHIFT, TARGET_DEPTH, TURN
from cell.calibration.verification_looks import CheckObservations, verify
from cell.config import load_config
from cell.geometry.poses import from_matrix
from cell.planning import rail_ends, verification_views
from cell.steps.verify import SCAN_APPROACHES, TARGET_APPROACHES
from cell.stored_calibration import CellCalibration
from sim_backends.world.scene import draw, rotation

PROFILES = 40
CHECKS_OF_A_GOOD_ONE = 4


@dataclass(frozen=True)
class Disturbance:
    """A part of the truth that is moved: what it is called, the part to be named, and the truth after it."""

    name: str
    part: str
    moved: Callable[[Truth], Truth]


@dataclass
class Tally:
    """Of the checks under one disturbance: how many, how many found, named first, and among the suspects."""

    checks: int = 0
    found: int = 0
    first: int = 0
    among: int = 0


@dataclass
class Campaign:
    """Result: tallies by disturbance, and the checks of good calibrations with their false alarms."""

    good: int = 0
    alarms: int = 0
    tallies: dict[str, Tally] = field(default_factory=dict)

    def summary(self, level: str, seeds: int) -> dict[str, Any]:
        """For reports."""
        return {
            "level": level,
            "seeds": seeds,
            "false_alarm_percent": round(100 * self.alarms / max(1, self.good), 2),
            "checks_of_good": self.good,
            "disturbances": [
                {
                    "name": name,
                    "checks": t.checks,
                    "found_percent": round(100 * t.found / t.checks, 1),
                    "named_first_percent": round(100 * t.first / max(1, t.found), 1),
                    "among_suspects_percent": round(100 * t.among / max(1, t.found), 1),
                }
                for name, t in self.tallies.items()
            ],
        }


def disturbances() -> list[Disturbance]:
    """Every single parameter of the chain moved by 0.2 mm or 0.05°, or by what does as much to a picture."""
    made: list[Disturbance] = []

    def add(name: str, part: str, moved: Callable[[Truth], Truth]) -> None:
        made.append(Disturbance(name, part, moved))

    for camera, depth in (("scan", SCAN_DEPTH), ("target", TARGET_DEPTH)):
        pose, lens = f"flange_from_{camera}", f"{camera}_lens"
        mount, glass = f"{camera} camera's mount on the flange", f"{camera} camera's lens"
        for axis in range(3):
            e = np.eye(3)[axis]
            add(f"{camera} mount, 0.2 mm along {'xyz'[axis]}", mount, _posed(pose, SHIFT * e, np.zeros(3)))
            add(f"{camera} mount, 0.05° about {'xyz'[axis]}", mount, _posed(pose, np.zeros(3), TURN * e))
        for k, name in ((2, "cx"), (3, "cy")):
            add(f"{camera} lens, 0.05° of {name}", glass, _lens(lens, TURN * np.eye(9)[k], np.zeros(9)))
        add(f"{camera} lens, 0.2 mm of focus", glass, _lens(lens, np.zeros(9), SHIFT / depth * (np.arange(9) < 2)))
    laser = "laser's light plane"
    add("light plane, 0.2 mm", laser, lambda t: replace(t, plane_distance=t.plane_distance + SHIFT))
    for axis, name in ((1, "about y"), (2, "about z")):
        turn = rotation(TURN * np.eye(3)[axis])
        add(f"light plane, 0.05° {name}", laser, _applied("plane_normal", turn))
        add(f"rail, 0.05° {name}", "rail", _applied("rail_direction", turn))
    add("rail, 0.2 mm per 100 mm of lead", "rail", _applied("rail_direction", (1 + SHIFT / 0.1) * np.eye(3)))
    return made


def look_again(cell: ObservedCell, calibration: CellCalibration) -> CheckObservations:
    """What `cell.steps.verify.collect_verification` brings from this world."""
    config = cell.config
    assert calibration.scan.reference is not None
    scan_view, target_view = verification_views(config, cell.fine, cell.large, calibration.scan, calibration.target)
    ends = rail_ends(
        calibration.scan, calibration.scan.reference.base_from_board, scan_view, cell.fine, config.rail.travel
    )
    photographs = []
    rest = cell.move(scan_view.base_from_flange.homogeneous)
    for k in range(SCAN_APPROACHES):
        if k:
            rest = cell.move(scan_view.base_from_flange.homogeneous)
        reported = from_matrix(rest.reported)
        photographs.append(
            [ScanObservation(cell.scan_view(rest, cell.carriage(end)), None, reported, end) for end in ends]
        )
    offset = cell.carriage(ends[0]) - ends[0]
    sweep = [
        ScanObservation(None, cell.stripe(rest, float(s) + offset), from_matrix(rest.reported), float(s))
        for s in np.linspace(*ends, PROFILES)
    ]
    target = []
    for _ in range(TARGET_APPROACHES):
        rest = cell.move(target_view.base_from_flange.homogeneous)
        target.append(TargetObservation(cell.target_view(rest), from_matrix(rest.reported)))
    return CheckObservations(photographs, sweep, target)


def campaign(
    seeds: Iterable[int], level: str, chosen: Iterable[Disturbance], progress: Callable[[str], None]
) -> Campaign:
    """Calibrate each seed's world, check it as it is and under each disturbance."""
    result = Campaign()
    chosen = list(chosen)
    config = load_config(None)
    for seed in seeds:
        progress(f"seed {seed}: calibrating")
        cell = ObservedCell(draw(seed, level), config, np.random.default_rng([seed, 20]))
        calibration = CellCalibration.solve(cell.collect_scan(), cell.collect_target(), {"arm": str(seed)}, config)
        truth = cell.truth
        for _ in range(CHECKS_OF_A_GOOD_ONE):
            result.good += 1
            result.alarms += not verify(calibration.scan, calibration.target, look_again(cell, calibration)).good
        for disturbance in chosen:
            progress(f"seed {seed}: {disturbance.name}")
            cell.truth = disturbance.moved(truth)
            verdict = verify(calibration.scan, calibration.target, look_again(cell, calibration))
            tally = result.tallies.setdefault(disturbance.name, Tally())
            tally.checks += 1
            if not verdict.good:
                parts = [suspect.part for suspect in verdict.suspects]
                tally.found += 1
                tally.first += parts[0] == disturbance.part
                tally.among += disturbance.part in parts
        cell.truth = truth
    return result


def _posed(name: str, shift: np.ndarray, turn: np.ndarray) -> Callable[[Truth], Truth]:
    change = np.eye(4)
    change[:3, :3], change[:3, 3] = rotation(turn), shift
    return lambda truth: replace(truth, **{name: getattr(truth, name) @ change})


def _lens(name: str, focal_lengths: np.ndarray, share: np.ndarray) -> Callable[[Truth], Truth]:
    """A lens moved by multiples of its focal length, and by shares of its own values."""
    return lambda truth: replace(
        truth, **{name: getattr(truth, name) * (1 + share) + getattr(truth, name)[0] * focal_lengths}
    )


def _applied(name: str, matrix: np.ndarray) -> Callable[[Truth], Truth]:
    return lambda truth: replace(truth, **{name: matrix @ getattr(truth, name)})
