"""A stored calibration is taken for its own devices, its own configuration and its own time only."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cell.calibration import ScanCalibration, TargetCalibration
from cell.calibration.archive import _pose
from cell.calibration.finding import find_calibration
from cell.calibration.sessions import marked, serial_numbers
from cell.calibration.solve.results import KEPT, Quality
from cell.calibration.store import CellCalibration, nominal_camera, save_calibration
from cell.config import load_config
from cell.devices.direct import VirtualCell
from cell.geometry.light_plane import LightPlane
from drivers.errors import CalibrationStale, NotConnectedError

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
