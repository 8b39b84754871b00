"""A stored calibration is taken for its own devices, its own configuration and its own time only."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cell.config.calibrations.finding import find_calibration
from cell.config.calibrations.store import (
    CalibrationEdited,
    CellCalibration,
    accept_calibration,
    nominal_camera,
    read_calibration,
    require_as_configured,
    save_calibration,
)
from cell.config.cell_config import load_config
from cell.measure.calibration import ScanCalibration, TargetCalibration
from cell.measure.calibration.archive import _pose
from cell.measure.calibration.drift.reference_plate import ConfirmedTurn, PlateLine
from cell.measure.calibration.solve.results import KEPT, Quality
from cell.measure.geometry.light_plane import LightPlane
from drivers.errors import CalibrationStale, ConfigError

DEVICES = {"arm": "A1", "rail": "R1", "scan_camera": "S1", "target_camera": "T1"}
CONFIGURATION = "0123456789abcdef"
DAY = 86400.0


CELL = load_config(None)


def made(age: float = DAY, devices: dict[str, str] = DEVICES, configuration: str = CONFIGURATION) -> CellCalibration:
    """A calibration that was made `age` s ago."""
    quality, mount = Quality(20, 1.0, 0.03, 1e-5, 0.03, 1e-5), pin.SE3.Identity()
    plane, along = LightPlane.of((1.0, 0.0, -1 / 3.5), -0.035), np.array([1.0, 0.0, 0.0])
    scan = ScanCalibration(nominal_camera(CELL.scan_camera), plane, along, mount, np.eye(KEPT), quality)
    target = TargetCalibration(nominal_camera(CELL.target_camera), mount, np.eye(6), quality)
    return CellCalibration(scan, target, dict(devices), configuration, time.time() - age)


def test_its_hash_tells_two_calibrations_apart():
    one = made()
    other = replace(one, target=replace(one.target, hand_eye_covariance=2.0 * np.eye(6)))
    assert one.hash() == replace(one).hash() != other.hash()


def test_a_kept_pose_that_is_mirrored_sheared_or_scaled_is_none():
    assert _pose(pin.SE3.Random().homogeneous, "view 1")
    for wrong in (np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.001, 1.0, 1.0, 1.0]), np.eye(4) + np.eye(4, k=1) * 1e-3):
        with pytest.raises(ValueError, match="view 1 is no rotation and translation"):
            _pose(wrong, "view 1")


def edited(path: Path, *keys: object, value: object) -> None:
    """Change one value of a stored file, as an editor does."""
    data = at = json.loads(path.read_text(encoding="utf-8"))
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    path.write_text(json.dumps(data), encoding="utf-8")


@pytest.mark.parametrize(
    ("keys", "value", "part"),
    [
        (("scan", "flange_from_camera", 0, 3), 0.001, "scan.flange_from_camera"),
        (("target", "hand_eye_covariance", 0, 0), 1.5, "target.hand_eye_covariance"),
        (("made",), 1.7e9, "made"),
        (("date",), "yesterday", "date"),
        (("scan", "further"), 1, "scan.further"),
        (("sha256",), "0" * 64, "its content or its digest"),
    ],
)
def test_an_edit_is_refused_by_name_until_a_person_accepts_it(
    tmp_path, keys: tuple[object, ...], value: object, part: str
):
    path = tmp_path / "own.json"
    save_calibration(made(), path)
    edited(path, *keys, value=value)
    told = rf"changed after it was written: {part}\. .*`cell calibrate accept own"
    with pytest.raises(CalibrationEdited, match=told):
        find_calibration(tmp_path, DEVICES, CONFIGURATION, 1e9)
    accepted = accept_calibration(path, "ann", "measured by hand")
    assert [(e["who"], e["why"], e["changed"]) for e in accepted.edits] == [("ann", "measured by hand", [part])]
    save_calibration(read_calibration(path), path)
    kept = find_calibration(tmp_path, DEVICES, CONFIGURATION, 1e9)
    assert kept.edits == accepted.edits
    assert kept.summary()["notes"][-1].startswith("edited by ann on 20")
    with pytest.raises(ConfigError, match="is as it was written"):
        accept_calibration(path, "ann", "again")


def test_one_without_its_digest_is_edited(tmp_path):
    path = tmp_path / "own.json"
    path.write_text(json.dumps(made().as_dict()), encoding="utf-8")
    with pytest.raises(CalibrationEdited, match="its digest, which is missing"):
        read_calibration(path)


def _scan(**changes: object) -> CellCalibration:
    stock = made()
    return replace(stock, scan=replace(stock.scan, **changes))


SKEW = np.eye(KEPT) + np.diag([0.5] * (KEPT - 1), 1)
ROWS = np.full(480, np.nan)
ROWS[100:200] = 300.0


@pytest.mark.parametrize(
    ("spoilt", "says"),
    [
        (_scan(covariance=0.0 * np.eye(KEPT)), r"scan\.covariance has a variance of 0"),
        (_scan(covariance=-np.eye(KEPT)), "has a variance of -1; all must be above 0"),
        (_scan(covariance=np.ones((KEPT, KEPT))), "not positive definite"),
        (_scan(covariance=SKEW), "not symmetric"),
        (_scan(bow_sigma=-1e-3), r"bow_sigma: -0\.001, allowed 0 to 10"),
        (_scan(rail_direction=np.array([1000.0, 0.0, 0.0])), r"its length: 1000, allowed 0\.98 to 1\.02"),
        (_scan(flange_from_camera=pin.SE3(np.eye(3), np.array([90.0, 0, 0]))), "flange_from_camera, m: 90"),
        (_scan(confirmed=ConfirmedTurn(0.0, 0.0, 1e-5, 4.07e9)), "confirmed.made lies .* hours in the future"),
        (_scan(witness=PlateLine(11.0, ROWS)), r"witness\.rail"),
        (replace(made(), target=replace(made().target, hand_eye_covariance=np.zeros((6, 6)))), "hand_eye_covariance"),
        (replace(made(), made=4.07e9), "hours in the future"),
        (replace(made(), made=0.0), "no date"),
    ],
)
def test_figures_that_no_calibration_has_are_refused_whoever_wrote_them(tmp_path, spoilt: CellCalibration, says: str):
    path = tmp_path / "own.json"
    save_calibration(replace(spoilt, edits=({"who": "a", "when": "b", "why": "c", "changed": []},)), path)
    with pytest.raises(CalibrationStale, match=says):
        read_calibration(path)


@pytest.mark.parametrize("text", ["NaN", "Infinity", "1e999", "1e300", '"x"', "null", "[]"])
@pytest.mark.parametrize("key", ["made", "covariance"])
def test_a_figure_that_is_no_number_is_an_error_in_our_words(tmp_path, text: str, key: str):
    path = tmp_path / "own.json"
    data = made().as_dict()
    (data if key == "made" else data["scan"])[key] = "HERE"
    path.write_text(json.dumps(data).replace('"HERE"', text), encoding="utf-8")
    with pytest.raises(CalibrationStale, match="cannot be read as a calibration"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("spoilt", "says"),
    [
        (_scan(flange_from_camera=pin.SE3.Identity()), r"scan\.flange_from_camera against its drawing"),
        (_scan(rail_direction=np.array([-1.0, 0.0, 0.0])), "rail_direction against"),
        (_scan(light_plane=LightPlane.of((1.0, 0.0, -1 / 3.5), -0.135)), "exit off it"),
        (_scan(camera=replace(nominal_camera(CELL.scan_camera), fx=800.0)), "fx and fy over the drawn"),
    ],
)
def test_one_that_does_not_fit_the_drawing_is_not_used(spoilt: CellCalibration, says: str):
    scan, target = (camera.flange_from_camera.se3() for camera in (CELL.scan_camera, CELL.target_camera))
    spoilt = replace(spoilt, target=replace(spoilt.target, flange_from_camera=target))
    require_as_configured(replace(spoilt, scan=replace(made().scan, flange_from_camera=scan)), CELL)
    if "flange_from_camera" not in says:
        spoilt = replace(spoilt, scan=replace(spoilt.scan, flange_from_camera=scan))
    with pytest.raises(CalibrationStale, match=says):
        require_as_configured(spoilt, CELL)
