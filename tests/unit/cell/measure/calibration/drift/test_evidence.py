"""Promises of the evidence for a change: of a good calibration it scatters as it says, and its reference is stored."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from cell.config.calibrations.store import CellCalibration, read_calibration, save_calibration
from cell.config.cell_config import load_config
from cell.measure.calibration.drift.decision import verdict
from cell.measure.calibration.drift.evidence import CHECKED_LARGE_VIEW, CHECKED_VIEW, Reference, evidence
from cell.measure.calibration.solve.normal import BOARD, SHARED, AdjustmentState
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import covariance_root, from_matrix
from cell.procedures.calibrate.verification import scan_looks, target_looks, verify
from drivers.errors import CalibrationStale
from lab.bench.calibration.observed_cell import ObservedCell
from lab.bench.calibration.verification import look_again
from sim_backends.world.scene import draw

CONFIG = load_config(None)


@pytest.fixture(scope="module")
def calibrated():
    cell = ObservedCell(draw(5, "harsh"), CONFIG, np.random.default_rng([5, 7]))
    return cell, cell.calibrated("1")


def true_state(cell: ObservedCell, calibration: CellCalibration, chain: str) -> AdjustmentState:
    t = cell.truth
    if chain == "target":
        lens, plane, rail = calibration.target.camera.with_parameters(t.target_lens), None, np.zeros(3)
        mount, board = t.flange_from_target, t.base_from_large
    else:
        lens, plane = (
            calibration.scan.camera.with_parameters(t.scan_lens),
            LightPlane.of(t.plane_normal, t.plane_distance),
        )
        rail, mount, board = t.rail_direction, t.flange_from_scan, t.base_from_fine
    return AdjustmentState(lens, plane, rail, from_matrix(mount), from_matrix(board))


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
        states, references = {}, {}
        for name, of in (("scan", calibration.scan), ("target", calibration.target)):
            root = covariance_root(of.reference.covariance)
            step = root @ quiet.rng.normal(size=root.shape[1])
            states[name] = state = true_state(quiet, calibration, name).moved(step)
            references[name] = Reference(
                state.base_from_board, of.reference.covariance, sigma.arm_repeatability / np.sqrt(3),
                sigma.arm_repeatability_rotation, float(rail), 1.0, 1.0,
            )  # fmt: skip
        scan, target = states["scan"], states["target"]
        made = CellCalibration(
            replace(calibration.scan, camera=scan.camera, light_plane=scan.plane, rail_direction=scan.rail_direction,
                    flange_from_camera=scan.flange_from_camera, reference=references["scan"]),
            replace(calibration.target, camera=target.camera, flange_from_camera=target.flange_from_camera,
                    reference=references["target"]),
            {}, "", 0.0,
        )  # fmt: skip
        seen = look_again(quiet, made)
        evidences = {
            "scan": evidence(scan, references["scan"], scan_looks(scan, seen), CHECKED_VIEW),
            "target": evidence(target, references["target"], target_looks(seen.target), CHECKED_LARGE_VIEW),
        }
        alarms += not verdict(evidences, states).good
        for weighed in evidences.values():
            moved, covariance = weighed.change(np.eye(SHARED)[:, BOARD])
            squares.append(moved @ np.linalg.solve(covariance, moved))
    freedom = 6 * len(squares)
    assert chi2.ppf(0.002, freedom) < np.sum(squares) < chi2.ppf(0.998, freedom)
    # At 3 % each, more than one of 7 happens once in sixty times, more than four of 42 once in a hundred and fifty.
    assert alarms <= most_alarms


def test_the_reference_is_stored_and_one_without_it_is_refused(calibrated, tmp_path):
    cell, calibration = calibrated
    save_calibration(calibration, tmp_path / "new.json")
    back = read_calibration(tmp_path / "new.json")
    np.testing.assert_allclose(back.scan.reference.covariance, calibration.scan.reference.covariance)
    boards = (one.scan.reference.base_from_board.homogeneous for one in (back, calibration))
    np.testing.assert_allclose(*boards, atol=1e-12)
    assert back.scan.reference.rail == calibration.scan.reference.rail
    with pytest.raises(CalibrationStale, match="reference"):
        verify(replace(back.scan, reference=None), back.target, look_again(cell, calibration))
