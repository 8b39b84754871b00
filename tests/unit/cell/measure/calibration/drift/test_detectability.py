"""Promises of what a verification says it can see: against the noncentral χ², and against drawn worlds.

Also that the evidence of a good calibration scatters as it says it does, where everything about the noise is known.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.measure.calibration.drift.decision import verdict
from cell.measure.calibration.drift.detectability import detectable
from cell.measure.calibration.drift.evidence import SHIFT, DriftEvidence, Reference, evidence, hypotheses, log_factor
from cell.measure.calibration.solve.normal import BOARD, HAND, SHARED, AdjustmentState
from cell.measure.calibration.solve.results import ScanCalibration, TargetCalibration
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import covariance_root, from_matrix
from cell.procedures.verify.verdict import Verification
from cell.procedures.verify.views import scan_looks, target_looks, verify
from lab.bench.calibration.observed_cell import ObservedCell
from lab.bench.calibration.verification import KINDS_OF_CHANGE, changed, look_again
from sim_backends.world.scene import draw

CONFIG = load_config(None)
SEED = 5


@pytest.fixture(scope="module")
def calibrated():
    """A harsh world; from the drawn pose its fine board lies half out of the picture."""
    cell = ObservedCell(draw(SEED, "harsh"), CONFIG, np.random.default_rng([SEED, 7]))
    return cell, CellCalibration.solve(cell.collect_scan(), cell.collect_target(), {"arm": "1"}, CONFIG)


def true_state(cell: ObservedCell, calibration: CellCalibration, chain: str) -> AdjustmentState:
    t = cell.truth
    if chain == "target":
        lens = calibration.target.camera.with_parameters(t.target_lens)
        return AdjustmentState(
            lens, None, np.zeros(3), from_matrix(t.flange_from_target), from_matrix(t.base_from_large)
        )
    lens, plane = calibration.scan.camera.with_parameters(t.scan_lens), LightPlane.of(t.plane_normal, t.plane_distance)
    return AdjustmentState(
        lens, plane, t.rail_direction, from_matrix(t.flange_from_scan), from_matrix(t.base_from_fine)
    )


def test_the_least_shift_is_that_of_the_noncentral_chi_square():
    # One hypothesis of three equally well known parameters: its statistic is a monotone function of a χ² of three.
    camera = CameraModel(1280, 1024, 1500.0, 1500.0, 639.5, 511.5, (0.0,) * 5)
    state = AdjustmentState(camera, None, np.zeros(3), from_matrix(np.eye(4)), from_matrix(np.eye(4)))
    information = np.zeros((SHARED, SHARED))
    index, known = np.arange(HAND.start, HAND.start + 3), 1 / (0.1 * SHIFT) ** 2
    information[index, index] = known
    weighed = DriftEvidence(np.zeros(SHARED), information, 1.0, float("nan"))
    shift = hypotheses("target", camera.fx)[0]
    rng = np.random.default_rng(4)
    scores = np.zeros((8000, SHARED))
    scores[:, index] = rng.normal(0.0, np.sqrt(known), (8000, 3))
    factors = log_factor(weighed, shift, scores)[:, None]
    least_score = np.zeros((1, SHARED))
    least_score[0, index[0]] = np.sqrt(chi2.isf(0.03, 3) * known)
    threshold = log_factor(weighed, shift, least_score)[0]
    assert np.mean(factors > threshold) == pytest.approx(0.03, abs=0.006)
    seen = detectable(
        {"target": weighed}, {"target": state}, [("target", shift)], {"target": scores}, factors, threshold
    )
    shown = brentq(lambda square: ncx2.sf(chi2.isf(0.03, 3), 3, square) - 0.95, 0.1, 100.0)
    # Of 2000 draws: 0.5 % of the share, which is 2 % of the size.
    assert seen[0].size == pytest.approx(np.sqrt(shown / known), rel=0.05)
    assert np.linalg.norm(seen[0].step[index]) == pytest.approx(seen[0].size)
    # Nothing else is known here, so nothing else shows.
    assert all(np.isinf(d.size) and not d.enough for d in seen[1:])


@pytest.mark.campaign
def test_what_is_called_detectable_is_found_and_what_is_far_below_is_not(calibrated):
    cell, calibration = calibrated
    before = cell.truth
    seen = verify(calibration.scan, calibration.target, look_again(cell, calibration)).detectable
    assert len(seen) == KINDS_OF_CHANGE
    found = {1.0: 0, 0.25: 0}
    try:
        for share, d in [(1.0, d) for d in seen] + [(0.25, d) for d in seen[::2]]:
            cell.truth = changed(before, replace(d, step=share * d.step))
            found[share] += not verify(calibration.scan, calibration.target, look_again(cell, calibration)).good
    finally:
        cell.truth = before
    # Of 12 at 95 %, fewer than 10 are found once in fifty times; a quarter of the size is found little above chance.
    assert found[1.0] >= 10
    assert found[0.25] <= 2


def test_a_good_verdict_says_within_what(calibrated):
    cell, calibration = calibrated
    verification = Verification.of(calibration, load_job("pot")[0], look_again(cell, calibration))
    summary = verification.summary()
    assert summary["good"]
    # In this cell the arm's scatter hides as much as is allowed, of the target camera and not of the rail.
    assert summary["verdict"] == "good"
    shows, allowed = summary["place"]["shows_from_mm"], summary["place"]["allowed_mm"]
    assert allowed == pytest.approx(0.6)
    assert 0.2 < shows < 0.9
    assert f"moves the place by more than {shows:.2f} mm would have shown" in summary["reason"]
    assert "allowed at the place are 0.60 mm" in summary["reason"]
    assert "could do that unseen: " in summary["reason"]
    assert "target camera's mount on the flange, turn (up to 0." in summary["reason"]
    assert "rail, turn" not in summary["reason"]
    json.dumps(summary, allow_nan=False)


@pytest.mark.parametrize(("checks", "most_alarms"), [(7, 1), pytest.param(42, 4, marks=pytest.mark.campaign)])
def test_the_evidence_of_a_good_calibration_scatters_as_it_says(calibrated, checks, most_alarms):
    """Calibrations drawn from their covariance about the truth, noise as stated: χ² of the boards, and few alarms."""
    cell, calibration = calibrated
    sigma = cell.scene.deviations
    # Without a kinematic error the arm's scatter is all that its poses are wrong by.
    quiet = ObservedCell(replace(cell.scene, dh_error=np.zeros((6, 4))), CONFIG, np.random.default_rng(3))
    rail = np.sqrt(sigma.rail_homing**2 + cell.scene.rail_backlash**2 / 4 + cell.scene.rail_periodic_amplitude**2 / 2)
    squares, alarms = [], 0
    for _ in range(checks):
        drawn = {}
        for name, of in (("scan", calibration.scan), ("target", calibration.target)):
            step = covariance_root(of.reference.covariance)
            step = step @ quiet.rng.normal(size=step.shape[1])
            state = true_state(quiet, calibration, name).moved(step)
            reference = Reference(
                state.base_from_board, of.reference.covariance, sigma.arm_repeatability / np.sqrt(3),
                sigma.arm_repeatability_rotation, float(rail), 1.0, 1.0,
            )  # fmt: skip
            drawn[name] = state, reference
        scan, target = (state for state, _ in drawn.values())
        made = CellCalibration(
            ScanCalibration(scan.camera, scan.plane, scan.rail_direction, scan.flange_from_camera,
                            calibration.scan.covariance, calibration.scan.quality, drawn["scan"][1]),
            TargetCalibration(target.camera, target.flange_from_camera, calibration.target.hand_eye_covariance,
                              calibration.target.quality, drawn["target"][1]),
            {}, "", 0.0,
        )  # fmt: skip
        seen = look_again(quiet, made)
        evidences = {
            "scan": evidence(scan, drawn["scan"][1], scan_looks(scan, seen)),
            "target": evidence(target, drawn["target"][1], target_looks(seen.target)),
        }
        alarms += not verdict(evidences, {"scan": scan, "target": target}).good
        for weighed in evidences.values():
            moved, covariance = weighed.change(np.eye(SHARED)[:, BOARD])
            squares.append(moved @ np.linalg.solve(covariance, moved))
    freedom = 6 * len(squares)
    assert chi2.ppf(0.002, freedom) < np.sum(squares) < chi2.ppf(0.998, freedom)
    # At 3 % each, more than one of 7 happens once in sixty times, more than four of 42 once in a hundred and fifty.
    assert alarms <= most_alarms
