"""A scan head that slipped since the calibration, and pictures that come later, are seen on the plate on the claw."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import load_config
from cell.measure.calibration import ScanObservation
from cell.measure.calibration.drift.evidence import INTERIM_VIEW, PictureMeasurements, dots_of
from cell.measure.calibration.drift.slip import CHANCE, LARGEST_LAG_S, LARGEST_M, NOTED_M, SUSPICIOUS, HeadShift, Slip
from cell.measure.calibration.solve.normal import HAND
from cell.measure.geometry.poses import from_matrix
from cell.procedures.arm.photograph import interim_view
from drivers.errors import RefusedError
from lab.bench.calibration.observed_cell import ObservedCell, shifted
from sim_backends.world.scene import draw, rotation

CONFIG = load_config(None)
Calibrated = tuple[ObservedCell, CellCalibration]


def test_what_is_small_is_silent_what_is_more_is_stated_and_the_rest_is_refused():
    axes = np.eye(3)[[1, 2, 0]]
    small, some, far = (Slip(size, 0.0, 0.0) for size in (0.9 * NOTED_M, 1.5 * NOTED_M, 1.1 * LARGEST_M))
    assert small.notes == () and not small.covariance(axes, 0.015).any()
    assert "slipped by +0.075 mm along" in some.notes[0]
    # In the base, along the camera's x axis, and no less than the plate shows.
    assert np.sqrt(np.diag(some.covariance(axes, 0.015))[2]) >= 1.5 * NOTED_M
    # A head that turned on its mount, 85 mm before the plate.
    assert np.sqrt(np.diag(some.covariance(axes, 0.015))[3:]) == pytest.approx(3 * [1.5 * NOTED_M / 0.085])
    early, late = Slip(0.0, 0.0, -1.8e-3), Slip(0.0, 0.0, 3e-3)
    assert early.notes == () and not early.covariance(axes, 0.015).any()
    assert "pictures come 3.0 ms later" in late.notes[0]
    # Along the rail, by what the sweep covers meanwhile.
    assert np.sqrt(np.diag(late.covariance(axes, 0.015))) == pytest.approx([0, 0, 45e-6, 0, 0, 0])
    small.require(), some.require()
    with pytest.raises(RefusedError, match=r"scan head has slipped by \+0\.165 mm along"):
        far.require()
    for along, across in ((-1.1, 0.0), (0.0, 1.1), (0.0, -1.1), (-0.8, 0.8), (np.nan, 0.0), (0.0, np.nan)):
        with pytest.raises(RefusedError, match="scan head has slipped"):
            Slip(along * LARGEST_M, across * LARGEST_M, 0.0).require()
    for lag, told in ((-1.1, "11.0 ms earlier"), (1.1, "11.0 ms later"), (np.nan, "nan ms")):
        with pytest.raises(RefusedError, match=told):
            Slip(0.0, 0.0, lag * LARGEST_LAG_S).require()


@pytest.fixture(scope="module")
def calibrated() -> Calibrated:
    cell = ObservedCell(draw(3, "nominal"), CONFIG, np.random.default_rng([3, 31]))
    return cell, cell.calibrated("3")


def look(cell: ObservedCell, calibration: CellCalibration, rests: int) -> HeadShift:
    scan = calibration.scan
    view = interim_view(CONFIG, cell.fine, scan)
    seen = []
    for k in range(rests):
        rest = cell.move(view.base_from_flange.homogeneous)
        photo = cell.scan_view(rest, cell.carriage(view.rail_position))
        one = ScanObservation(photo, None, from_matrix(rest.reported), view.rail_position)
        seen.append(PictureMeasurements(dots_of(one), k, k))
    return HeadShift.of(scan.state(scan.reference.base_from_board), scan.reference, seen)


def test_a_head_that_nobody_touched_is_as_uncertain_as_it_is_said(calibrated: Calibrated):
    cell, calibration = calibrated
    looks = [look(cell, calibration, 1) for _ in range(40)]
    squares = [one.change @ np.linalg.solve(one.covariance, one.change) for one in looks]
    # All share the calibration's error, so that their mean may lie anywhere within what one of them leaves open.
    assert np.mean(squares) < chi2.ppf(0.999, 6)
    about = np.array([one.change for one in looks])
    assert (about.std(axis=0) < 1.3 * np.sqrt(np.diag(looks[0].covariance))).all()
    assert not any(one.changed for one in looks) and all(one.fits for one in looks)
    assert np.mean([one.suspicious for one in looks]) < 0.4


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_shift_and_a_turn_are_found_and_told_by_how_much(calibrated: Calibrated, axis: int, monkeypatch):
    cell, calibration = calibrated
    truth, mount = cell.truth, cell.truth.flange_from_scan
    expected = 0.3e-3 * np.eye(3)[axis]
    monkeypatch.setattr(cell, "truth", replace(truth, flange_from_scan=shifted(expected) @ mount))
    found = look(cell, calibration, 2)
    assert found.changed and found.looks == 2
    assert np.abs(found.change[:3] - expected).max() < 4.0 * np.sqrt(np.diag(found.covariance))[:3].max()
    turned = mount.copy()
    turned[:3, :3] = rotation(1e-3 * np.eye(3)[axis]) @ mount[:3, :3]
    monkeypatch.setattr(cell, "truth", replace(truth, flange_from_scan=turned))
    found = look(cell, calibration, 2)
    assert found.changed
    assert found.change[3 + axis] == pytest.approx(1e-3, abs=4.0 * np.sqrt(found.covariance[3 + axis, 3 + axis]))


def test_what_the_arm_errs_by_in_that_posture_is_no_change_of_the_head(calibrated: Calibrated, monkeypatch):
    cell, calibration = calibrated
    truth, off = cell.truth, shifted(np.array([0.25e-3, 0.0, 0.0]))
    scan = replace(calibration.scan, reference=replace(calibration.scan.reference, arm_translation=0.15e-3))
    known = scan.reference.pictures[INTERIM_VIEW]
    monkeypatch.setattr(cell, "truth", replace(truth, base_from_fine=off @ truth.base_from_fine))
    camera = known.base_from_flange * scan.flange_from_camera_at(known.rail)
    known = replace(known, camera_from_board=camera.inverse() * from_matrix(off) * camera * known.camera_from_board)
    as_then = replace(scan, reference=replace(scan.reference, pictures={INTERIM_VIEW: known}))
    assert look(cell, replace(calibration, scan=scan), 4).changed
    assert not look(cell, replace(calibration, scan=as_then), 4).changed


def test_a_board_that_was_bent_fits_badly_wherever_the_head_is(calibrated: Calibrated, monkeypatch):
    monkeypatch.setattr(calibrated[0], "bend", 0.2e-3)
    found = look(*calibrated, 1)
    assert not found.fits and 3.0 < found.dots < 5.5


def test_more_rests_make_it_sharper_down_to_the_calibrations_own_error(calibrated: Calibrated):
    sigma = [np.sqrt(np.diag(look(*calibrated, rests).covariance)) for rests in (1, 2, 8)]
    assert (sigma[1] < 0.85 * sigma[0]).all() and (sigma[2] < 0.85 * sigma[1]).all()
    assert (sigma[2] > 0.25 * sigma[0]).all()


def test_what_chance_seldom_brings_is_looked_at_again_and_what_it_never_brings_has_changed():
    made = HeadShift(np.zeros(6), np.eye(6), dots=1.0, chance=1.0, looks=1)
    assert not made.suspicious and not made.changed
    assert replace(made, chance=0.99 * SUSPICIOUS).suspicious and not replace(made, chance=1.01 * SUSPICIOUS).suspicious
    assert replace(made, chance=0.99 * CHANCE).changed and not replace(made, chance=1.01 * CHANCE).changed
    assert replace(made, dots=1.59).fits and not replace(made, dots=1.61).fits


def test_changes_are_drawn_about_the_one_that_was_found_and_of_the_mount_alone():
    sigma = np.array([1e-5, 2e-5, 3e-5, 1e-4, 2e-4, 3e-4])
    found = HeadShift(1e-3 * np.arange(1.0, 7.0), np.diag(sigma**2), dots=1.0, chance=1.0, looks=1)
    drawn = found.drawn(4000)
    assert np.allclose(drawn[:, HAND].mean(axis=0), found.change, atol=0.1 * sigma.max())
    assert drawn[:, HAND].std(axis=0) == pytest.approx(sigma, rel=0.06)
    others = np.delete(drawn, np.arange(HAND.start, HAND.stop), axis=1)
    assert not others.any() and not np.delete(found.likely, np.arange(HAND.start, HAND.stop)).any()
    assert (found.likely[HAND] == found.change).all()
    assert (found.drawn(4) == found.drawn(4)).all()
