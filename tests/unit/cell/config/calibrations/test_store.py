"""A stored calibration is taken for its own devices, its own configuration and its own time only."""

from __future__ import annotations

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
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration import ScanCalibration, TargetCalibration
from cell.measure.calibration.archive import _pose
from cell.measure.calibration.drift.reference_plate import ConfirmedTurn, PlateLine
from cell.measure.calibration.solve.results import KEPT, Quality
from cell.measure.geometry.light_plane import LightPlane
from cell.run.calibration import marked, serial_numbers
from drivers.errors import CalibrationStale, ConfigError, NotConnectedError

DEVICES = {"arm": "A1", "rail": "R1", "scan_camera": "S1", "target_camera": "T1"}
CONFIGURATION = "0123456789abcdef"
DAY = 86400.0
MAX_AGE = 30 * DAY


def made(
    age: float = 1 * DAY, devices: dict[str, str] = DEVICES, configuration: str = CONFIGURATION
) -> CellCalibration:
    """A calibration that was made `age` s ago."""
    quality = Quality(20, 1.0, 0.03, 1e-5, 0.03, 1e-5)
    config = load_config(None)
    plane = LightPlane.of((1.0, 0.0, -1 / 3.5), -0.035)
    scan = ScanCalibration(
        nominal_camera(config.scan_camera), plane, np.array([1.0, 0.0, 0.0]), pin.SE3.Identity(), np.eye(KEPT), quality
    )
    target = TargetCalibration(nominal_camera(config.target_camera), pin.SE3.Identity(), np.eye(6), quality)
    return CellCalibration(scan, target, dict(devices), configuration, time.time() - age)


def found(folder: Path) -> CellCalibration:
    return find_calibration(folder, DEVICES, CONFIGURATION, MAX_AGE)


def test_the_own_one_is_found_as_it_was_stored(tmp_path: Path) -> None:
    stored = made()
    save_calibration(stored, tmp_path / "own.json")
    assert found(tmp_path).as_dict() == stored.as_dict()


def test_of_several_the_newest_is_taken(tmp_path: Path) -> None:
    for age in (3, 1, 2):
        save_calibration(made(age * DAY), tmp_path / f"{age}.json")
    assert (time.time() - found(tmp_path).made) / DAY == pytest.approx(1, abs=0.01)


def test_none_at_all_says_how_to_get_one(tmp_path: Path) -> None:
    with pytest.raises(CalibrationStale, match=r"no calibration of these devices.*run `cell calibrate`"):
        found(tmp_path / "missing")


@pytest.mark.parametrize("device", sorted(DEVICES))
def test_that_of_another_device_is_not_taken(tmp_path: Path, device: str) -> None:
    save_calibration(made(devices={**DEVICES, device: "other"}), tmp_path / "other.json")
    with pytest.raises(CalibrationStale, match=rf"no calibration of these devices.*{device} {DEVICES[device]}.*of 1"):
        found(tmp_path)


@pytest.mark.parametrize(("kept", "now"), [("UR10e 0a1b", "UR10e 2c3d"), ("", "UR10e 2c3d"), ("UR10e 0a1b", "")])
def test_that_of_another_kinematics_of_the_arm_is_not_taken(tmp_path: Path, kept: str, now: str) -> None:
    save_calibration(replace(made(), kinematics=kept), tmp_path / "own.json")
    with pytest.raises(CalibrationStale, match="another kinematics of the arm") as caught:
        find_calibration(tmp_path, DEVICES, CONFIGURATION, MAX_AGE, now)
    for word in (kept or "it does not say which", now or "none that is known", "30001", "run `cell calibrate`"):
        assert word in str(caught.value)
    assert find_calibration(tmp_path, DEVICES, CONFIGURATION, MAX_AGE, kept).kinematics == kept


def test_an_arm_that_was_not_asked_is_asked_again_before_anything_is_calibrated_anew(tmp_path: Path) -> None:
    save_calibration(replace(made(), kinematics="UR10e 0a1b"), tmp_path / "own.json")
    why = "port 30001 of 10.0.0.5 sent none within 10 s"
    with pytest.raises(NotConnectedError, match=f"30001 was not read now: {why}; .*UR10e 0a1b.*connect anew") as caught:
        find_calibration(tmp_path, DEVICES, CONFIGURATION, MAX_AGE, "UR10e as drawn", why)
    assert "cell calibrate" not in str(caught.value)
    with pytest.raises(CalibrationStale, match="holds no calibration of these devices"):
        find_calibration(tmp_path / "none", DEVICES, CONFIGURATION, MAX_AGE, "UR10e as drawn", why)


def test_the_arm_that_was_exchanged_is_named(tmp_path: Path) -> None:
    save_calibration(made(devices={**DEVICES, "arm": "B7"}), tmp_path / "other.json")
    save_calibration(made(devices={**DEVICES, "arm": "B8", "rail": "R9"}), tmp_path / "far.json")
    with pytest.raises(CalibrationStale, match=r"was made with another one: arm B7; run"):
        found(tmp_path)


def test_that_of_fewer_or_more_devices_is_not_taken(tmp_path: Path) -> None:
    save_calibration(made(devices={"arm": "A1"}), tmp_path / "fewer.json")
    save_calibration(made(devices={**DEVICES, "mirror": "M1"}), tmp_path / "more.json")
    with pytest.raises(CalibrationStale, match="of 2 stored"):
        found(tmp_path)


def test_that_of_another_configuration_is_not_taken(tmp_path: Path) -> None:
    save_calibration(made(configuration="fedcba9876543210"), tmp_path / "own.json")
    with pytest.raises(CalibrationStale, match=r"another configuration \(fedcba9876543210, now 0123456789abcdef\)"):
        found(tmp_path)


@pytest.mark.parametrize("age", [MAX_AGE + 60.0, 400 * DAY])
def test_one_that_is_too_old_is_not_taken(tmp_path: Path, age: float) -> None:
    save_calibration(made(age), tmp_path / "own.json")
    with pytest.raises(CalibrationStale, match=r"days old, allowed are 30\.0"):
        found(tmp_path)
    save_calibration(made(MAX_AGE - 60.0), tmp_path / "own.json")
    found(tmp_path)


def test_a_newer_one_that_does_not_fit_does_not_hide_the_own_one(tmp_path: Path) -> None:
    own = made(5 * DAY)
    save_calibration(own, tmp_path / "own.json")
    save_calibration(made(1 * DAY, configuration="fedcba9876543210"), tmp_path / "a.json")
    save_calibration(made(1 * DAY, devices={**DEVICES, "rail": "R2"}), tmp_path / "z.json")
    assert found(tmp_path).made == pytest.approx(own.made)


def test_a_torn_file_is_named_and_not_taken(tmp_path: Path) -> None:
    save_calibration(made(), tmp_path / "own.json")
    text = (tmp_path / "own.json").read_text(encoding="utf-8")
    (tmp_path / "own.json").write_text(text[: len(text) // 2], encoding="utf-8")
    with pytest.raises(CalibrationStale, match=r"1 unreadable \(own\.json\)"):
        found(tmp_path)


def test_its_hash_tells_two_calibrations_apart() -> None:
    one = made()
    other = replace(one, target=replace(one.target, hand_eye_covariance=2.0 * np.eye(6)))
    assert one.hash() == replace(one).hash() != other.hash()


def test_one_from_the_future_is_not_taken(tmp_path: Path) -> None:
    save_calibration(made(-2 * DAY), tmp_path / "future.json")
    with pytest.raises(CalibrationStale, match=r"48\.0 hours in the future"):
        found(tmp_path)


@pytest.mark.parametrize(
    ("stored", "now"),
    [(("scan_camera", "laser"), ()), ((), ("scan_camera",)), (("scan_camera",), ("scan_camera", "rail"))],
)
def test_one_with_simulated_devices_is_none_of_the_real_ones_nor_the_other_way_round(
    tmp_path: Path, stored: tuple[str, ...], now: tuple[str, ...]
) -> None:
    save_calibration(made(devices=marked(DEVICES, stored)), tmp_path / "own.json")
    with pytest.raises(CalibrationStale, match="no calibration of these devices"):
        find_calibration(tmp_path, marked(DEVICES, now), CONFIGURATION, MAX_AGE)
    assert find_calibration(tmp_path, marked(DEVICES, stored), CONFIGURATION, MAX_AGE).identities["arm"] == "A1"


def test_a_calibration_belongs_to_the_arm_the_rail_and_both_cameras() -> None:
    """An exchanged one of these is another cell: each is asked itself."""
    devices = VirtualCell(load_config(None), 1).devices
    assert serial_numbers(devices) == {name: getattr(devices, name).identity().serial for name in DEVICES}


def test_a_file_of_another_format_or_with_a_number_missing_is_none(tmp_path: Path) -> None:
    save_calibration(made(), tmp_path / "own.json")
    data = json.loads((tmp_path / "own.json").read_text(encoding="utf-8"))
    for spoilt in ({**data, "format": data["format"] + 1}, {key: data[key] for key in data if key != "made"}):
        (tmp_path / "own.json").write_text(json.dumps(spoilt), encoding="utf-8")
        with pytest.raises(CalibrationStale, match=r"unreadable \(own\.json\)"):
            found(tmp_path)


def test_a_kept_pose_that_is_mirrored_sheared_or_scaled_is_none() -> None:
    assert _pose(pin.SE3.Random().homogeneous, "view 1")
    for wrong in (np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.001, 1.0, 1.0, 1.0]), np.eye(4) + np.eye(4, k=1) * 1e-3):
        with pytest.raises(ValueError, match="view 1 is no rotation and translation"):
            _pose(wrong, "view 1")


# --- edits and figures that cannot be ---


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
    tmp_path: Path, keys: tuple[object, ...], value: object, part: str
) -> None:
    path = tmp_path / "own.json"
    save_calibration(made(), path)
    edited(path, *keys, value=value)
    with pytest.raises(
        CalibrationEdited, match=rf"changed after it was written: {part}\. .*`cell calibrate accept own"
    ):
        find_calibration(tmp_path, DEVICES, CONFIGURATION, 1e9)
    accepted = accept_calibration(path, "ann", "measured by hand")
    assert [(e["who"], e["why"], e["changed"]) for e in accepted.edits] == [("ann", "measured by hand", [part])]
    save_calibration(read_calibration(path), path)
    kept = find_calibration(tmp_path, DEVICES, CONFIGURATION, 1e9)
    assert kept.edits == accepted.edits
    assert kept.summary()["notes"][-1].startswith("edited by ann on 20")
    with pytest.raises(ConfigError, match="is as it was written"):
        accept_calibration(path, "ann", "again")


def test_another_cells_edited_file_does_not_hide_the_own_one(tmp_path: Path) -> None:
    save_calibration(made(), tmp_path / "own.json")
    save_calibration(made(devices={**DEVICES, "arm": "B7"}), tmp_path / "other.json")
    edited(tmp_path / "other.json", "made", value=1.7e9)
    assert found(tmp_path).identities == DEVICES


def test_an_edited_copy_does_not_hide_the_intact_one(tmp_path: Path) -> None:
    own = made()
    save_calibration(own, tmp_path / "own.json")
    save_calibration(made(0.5 * DAY), tmp_path / "copy.json")
    edited(tmp_path / "copy.json", "scan", "flange_from_camera", 0, 3, value=0.001)
    assert found(tmp_path).hash() == own.hash()
    (note,) = found(tmp_path).scan.unread
    assert "copy.json was changed after it was written: scan.flange_from_camera" in note
    assert note in found(tmp_path).summary()["notes"]


def test_an_edited_file_of_the_cell_itself_is_refused_beside_any_copy(tmp_path: Path) -> None:
    path = tmp_path / f"{made().name}.json"
    save_calibration(made(), path)
    save_calibration(made(0.5 * DAY), tmp_path / "copy.json")
    edited(path, "scan", "flange_from_camera", 0, 3, value=0.001)
    with pytest.raises(CalibrationEdited, match="changed after it was written"):
        found(tmp_path)


def test_one_without_its_digest_is_edited_and_one_from_before_is_read_with_a_note(tmp_path: Path) -> None:
    path, own = tmp_path / "own.json", made()
    path.write_text(json.dumps(own.as_dict()), encoding="utf-8")
    with pytest.raises(CalibrationEdited, match="its digest, which is missing"):
        found(tmp_path)
    path.write_text(json.dumps({**own.as_dict(), "format": 1}), encoding="utf-8")
    assert found(tmp_path).hash() == own.hash()
    assert "before its file had a digest" in found(tmp_path).scan.unread[0]
    # Stored again, by a verification for one, it is no better known than before.
    save_calibration(replace(found(tmp_path), kinematics=""), path)
    assert "sha256" not in json.loads(path.read_text())
    assert "before its file had a digest" in found(tmp_path).scan.unread[0]
    accept_calibration(path, "ann", "the one of last week")
    assert found(tmp_path).scan.unread == ()


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
        (_scan(witness=PlateLine(0.0, ROWS, 0.0 * ROWS)), r"witness\.sigma"),
        (replace(made(), target=replace(made().target, hand_eye_covariance=np.zeros((6, 6)))), "hand_eye_covariance"),
        (replace(made(), made=4.07e9), "hours in the future"),
        (replace(made(), made=0.0), "no date"),
    ],
)
def test_figures_that_no_calibration_has_are_refused_whoever_wrote_them(
    tmp_path: Path, spoilt: CellCalibration, says: str
) -> None:
    path = tmp_path / "own.json"
    save_calibration(replace(spoilt, edits=({"who": "a", "when": "b", "why": "c", "changed": []},)), path)
    with pytest.raises(CalibrationStale, match=says):
        read_calibration(path)


@pytest.mark.parametrize("text", ["NaN", "Infinity", "1e999", "1e300", '"x"', "null", "[]"])
@pytest.mark.parametrize("key", ["made", "covariance"])
def test_a_figure_that_is_no_number_is_an_error_in_our_words(tmp_path: Path, text: str, key: str) -> None:
    path = tmp_path / "own.json"
    data = made().as_dict()
    (data if key == "made" else data["scan"])[key] = "HERE"
    path.write_text(json.dumps({**data, "format": 1}).replace('"HERE"', text), encoding="utf-8")
    with pytest.raises(CalibrationStale, match="cannot be read as a calibration"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("spoilt", "says"),
    [
        (_scan(flange_from_camera=pin.SE3.Identity()), r"scan\.flange_from_camera against its drawing"),
        (_scan(rail_direction=np.array([-1.0, 0.0, 0.0])), "rail_direction against"),
        (_scan(light_plane=LightPlane.of((1.0, 0.0, -1 / 3.5), -0.135)), "exit off it"),
        (_scan(camera=replace(nominal_camera(load_config(None).scan_camera), fx=800.0)), "fx and fy over the drawn"),
    ],
)
def test_one_that_does_not_fit_the_drawing_is_not_used(spoilt: CellCalibration, says: str) -> None:
    config = load_config(None)
    drawn = {"flange_from_camera": config.scan_camera.flange_from_camera.se3()}
    spoilt = replace(
        spoilt, target=replace(spoilt.target, flange_from_camera=config.target_camera.flange_from_camera.se3())
    )
    fits = replace(spoilt, scan=replace(made().scan, **drawn))
    require_as_configured(fits, config)
    if "flange_from_camera" not in says:
        spoilt = replace(spoilt, scan=replace(spoilt.scan, **drawn))
    with pytest.raises(CalibrationStale, match=says):
        require_as_configured(spoilt, config)
