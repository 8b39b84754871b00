"""How often `cell calibrate verify` finds a disturbed calibration, names its part, and raises a false alarm.

Each seed's world is calibrated from synthetic observations and then looked at again: as it was, with one part moved by
0.2 mm or 0.05°, with one part moved by what the verification says that it can just find, in the least visible
direction, and with one moved anyhow so that the place of a job is off by a third of its tolerance. The observations
are `lab.bench.calibration.observed_cell`'s: the simulator's optics, arm and deviations.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.measure.calibration import ScanObservation, TargetObservation
from cell.measure.calibration.drift.decision import Change, Detectable
from cell.measure.calibration.drift.evidence import SCAN_DEPTH, SHIFT, TARGET_DEPTH, TURN
from cell.measure.calibration.solve.normal import CAMERA, HAND, PLANE, RAIL, tangents
from cell.measure.geometry.poses import from_matrix
from cell.procedures.arm.photograph import rail_ends, verification_views
from cell.procedures.calibrate.verification import (
    SCAN_APPROACHES,
    TARGET_APPROACHES,
    CheckObservations,
    Verification,
    at_place,
    verify,
)
from lab.bench.calibration.observed_cell import ObservedCell, Truth
from sim_backends.world.scene import draw, rotation

PROFILES = 40
CHECKS_OF_A_GOOD_ONE = 4
KINDS_OF_CHANGE = 12
"""That the verification states a detectable size of."""


@dataclass(frozen=True)
class Disturbance:
    """A part of the truth that is moved: what it is called, the part to be named, how it moves, and the truth then."""

    name: str
    part: str
    kind: str
    moved: Callable[[Truth], Truth]


@dataclass
class Promise:
    """The checks under a change of one kind as large as the verification says that it finds: sizes in m or rad."""

    change: Change
    sizes: list[float] = field(default_factory=list)
    found: list[bool] = field(default_factory=list)
    bad_at_a_third: list[bool] = field(default_factory=list)
    """Called bad, of as many checks of a change that moves the place by a third of its tolerance."""

    def summary(self) -> dict[str, Any]:
        """For reports, in mm or degrees."""
        factor = 1e3 if self.change.unit == "m" else float(np.degrees(1.0))
        return {
            "part": self.change.part, "change": self.change.kind, "mean": round(factor * float(np.mean(self.sizes)), 4),
            "largest": round(factor * max(self.sizes), 4), "wanted": round(factor * self.change.wanted, 4),
            "unit": ("mm" if self.change.unit == "m" else "deg") + self.change.where, "checks": len(self.sizes),
            "found_percent": _percent(self.found), "bad_at_a_third_percent": _percent(self.bad_at_a_third),
        }  # fmt: skip


def disturbances() -> list[Disturbance]:
    """Every single parameter of the chain moved by 0.2 mm or 0.05°, or by what does as much to a picture."""
    made: list[Disturbance] = []

    def add(name: str, part: str, kind: str, moved: Callable[[Truth], Truth]) -> None:
        made.append(Disturbance(name, part, kind, moved))

    for camera, depth in (("scan", SCAN_DEPTH), ("target", TARGET_DEPTH)):
        pose, lens = f"flange_from_{camera}", f"{camera}_lens"
        mount, glass = f"{camera} camera's mount on the flange", f"{camera} camera's lens"
        for axis in range(3):
            e = np.eye(3)[axis]
            add(f"{camera} mount, 0.2 mm along {'xyz'[axis]}", mount, "shift", _posed(pose, SHIFT * e, np.zeros(3)))
            add(f"{camera} mount, 0.05° about {'xyz'[axis]}", mount, "turn", _posed(pose, np.zeros(3), TURN * e))
        for k, name in ((2, "cx"), (3, "cy")):
            add(
                f"{camera} lens, 0.05° of {name}", glass, "principal point",
                _lens(lens, TURN * np.eye(9)[k], np.zeros(9)),
            )  # fmt: skip
        add(
            f"{camera} lens, 0.2 mm of focus", glass, "focal length",
            _lens(lens, np.zeros(9), SHIFT / depth * (np.arange(9) < 2)),
        )  # fmt: skip
    laser = "laser's light plane"
    add("light plane, 0.2 mm", laser, "shift", lambda t: replace(t, plane_distance=t.plane_distance + SHIFT))
    for axis, name in ((1, "about y"), (2, "about z")):
        turn = rotation(TURN * np.eye(3)[axis])
        add(f"light plane, 0.05° {name}", laser, "turn", _applied("plane_normal", turn))
        add(f"rail, 0.05° {name}", "rail", "turn", _applied("rail_direction", turn))
    add("rail, 0.2 mm per 100 mm of lead", "rail", "lead", _applied("rail_direction", (1 + SHIFT / 0.1) * np.eye(3)))
    return made


def look_again(cell: ObservedCell, calibration: CellCalibration) -> CheckObservations:
    """What `cell.procedures.calibrate.verification.collect_verification` brings from this world."""
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
    seeds: Sequence[int], level: str, chosen: Sequence[Disturbance], progress: Callable[[str], None]
) -> dict[str, Any]:
    """Calibrate each seed's world, check it as it is and under each disturbance; for reports. Beside each disturbance
    stands what the verifications said of the size they find of its kind."""
    config, job = load_config(None), load_job("pot")[0]
    alarms: list[list[bool]] = []
    told: list[bool] = []
    suspected: dict[str, list[list[str]]] = {disturbance.name: [] for disturbance in chosen}
    promises: dict[tuple[str, str], Promise] = {}
    for seed in seeds:
        progress(f"seed {seed}: calibrating")
        cell = ObservedCell(draw(seed, level), config, np.random.default_rng([seed, 20]))
        calibration = cell.calibrated(str(seed))
        truth, effect = cell.truth, at_place(calibration, job)
        checks = [Verification.of(calibration, job, look_again(cell, calibration)) for _ in range(CHECKS_OF_A_GOOD_ONE)]
        alarms.append([not check.good for check in checks])
        told += [not check.verdict.good for check in checks]
        for seen in checks[-1].verdict.detectable:
            key = seen.change.part, seen.change.kind
            progress(f"seed {seed}: {', '.join(key)}")
            cell.truth = changed(truth, seen)
            verdict = verify(calibration.scan, calibration.target, look_again(cell, calibration))
            promise = promises.setdefault(key, Promise(seen.change))
            promise.sizes.append(seen.size)
            promise.found.append(not verdict.good)
            step = seen.change.directions @ cell.rng.normal(size=seen.change.directions.shape[1])
            step *= 1e-4 / np.linalg.norm(step)
            for _ in range(3):
                step *= job.place.tolerance / 3 / effect(seen.change.chain, step)
            cell.truth = changed(truth, replace(seen, step=step))
            third = Verification.of(calibration, job, look_again(cell, calibration))
            promise.bad_at_a_third.append(not third.good)
        for disturbance in chosen:
            progress(f"seed {seed}: {disturbance.name}")
            cell.truth = disturbance.moved(truth)
            verdict = verify(calibration.scan, calibration.target, look_again(cell, calibration))
            parts = [] if verdict.good else [suspect.part for suspect in verdict.suspects]
            suspected[disturbance.name].append(parts)
    promised = {key: promise.summary() for key, promise in promises.items()}
    false = [alarm for checks_of_one in alarms for alarm in checks_of_one]
    return {
        "level": level, "seeds": len(seeds), "false_alarm_percent": _percent(false, 2), "checks_of_good": len(false),
        "change_seen_percent": _percent(told, 2), "calibrations_with_a_false_alarm": sum(map(any, alarms)),
        "disturbances": [_row(each, suspected[each.name], promised[each.part, each.kind]) for each in chosen],
        "detectable": list(promised.values()),
        "bad_at_a_third_percent": _percent([bad for each in promises.values() for bad in each.bad_at_a_third]),
        "found_at_detectable_percent": _percent([found for each in promises.values() for found in each.found]),
    }  # fmt: skip


def _row(disturbance: Disturbance, suspected: Sequence[Sequence[str]], promised: dict[str, Any]) -> dict[str, Any]:
    """How often it was found, and its part named first and among the suspects; a check that is good suspects none."""
    found = [parts for parts in suspected if parts]
    return {
        "name": disturbance.name, "checks": len(suspected),
        "found_percent": _percent([bool(parts) for parts in suspected]), "detectable_mean": promised["mean"],
        "wanted": promised["wanted"], "unit": promised["unit"],
        "named_first_percent": _percent([parts[0] == disturbance.part for parts in found]),
        "among_suspects_percent": _percent([disturbance.part in parts for parts in found]),
    }  # fmt: skip


def _percent(those: Sequence[bool], digits: int = 1) -> float:
    return round(100 * sum(those) / max(1, len(those)), digits)


def changed(truth: Truth, seen: Detectable) -> Truth:
    """The truth after a change of just the size that can be seen, which is along the parameters of the calibration."""
    step, chain = seen.step, seen.change.chain
    pose, lens = f"flange_from_{chain}", f"{chain}_lens"
    mount = getattr(truth, pose).copy()
    mount[:3, 3] += step[HAND][:3]
    mount[:3, :3] = rotation(step[HAND][3:]) @ mount[:3, :3]
    normal = truth.plane_normal + np.column_stack(tangents(truth.plane_normal)) @ step[PLANE][:2]
    return replace(
        truth, **{pose: mount, lens: getattr(truth, lens) + step[CAMERA]}, plane_normal=normal / np.linalg.norm(normal),
        plane_distance=truth.plane_distance + step[PLANE][2], rail_direction=truth.rail_direction + step[RAIL],
    )  # fmt: skip


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
