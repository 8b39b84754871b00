"""A stored calibration is taken for its own devices, its own configuration and its own time only."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cell.config.calibrations.finding import find_calibration
from cell.config.calibrations.store import CalibrationEdited, CellCalibration, save_calibration
from cell.run.calibration import marked
from drivers.errors import CalibrationStale, NotConnectedError
from tests.unit.cell.config.calibrations.test_store import CONFIGURATION, DAY, DEVICES, edited, made

MAX_AGE = 30 * DAY


def found(folder: Path) -> CellCalibration:
    return find_calibration(folder, DEVICES, CONFIGURATION, MAX_AGE)


def test_of_several_the_newest_is_taken(tmp_path):
    stored = [made(age * DAY) for age in (3, 1, 2)]
    for k, calibration in enumerate(stored):
        save_calibration(calibration, tmp_path / f"{k}.json")
    assert found(tmp_path).made == stored[1].made


OTHER = "fedcba9876543210"


def of(**other: str) -> CellCalibration:
    return made(devices={**DEVICES, **other})


@pytest.mark.parametrize(
    ("stored", "says"),
    [
        ([], r"no calibration of these devices.*run `cell calibrate`"),
        *(
            ([of(**{device: "other"})], rf"no calibration of these devices.*{device} {serial}.*of 1")
            for device, serial in DEVICES.items()
        ),
        ([of(arm="B7"), of(arm="B8", rail="R9")], r"was made with another one: arm B7; run"),
        ([made(devices={"arm": "A1"}), of(mirror="M1")], "of 2 stored"),
        ([made(configuration=OTHER)], rf"another configuration \({OTHER}, now {CONFIGURATION}\)"),
        ([made(MAX_AGE + 60.0)], r"days old, allowed are 30\.0"),
        ([made(400 * DAY)], r"days old, allowed are 30\.0"),
        ([made(-2 * DAY)], r"\d\d\.\d hours in the future"),
    ],
)
def test_one_that_does_not_fit_is_not_taken(tmp_path, stored: list[CellCalibration], says: str):
    for k, calibration in enumerate(stored):
        save_calibration(calibration, tmp_path / f"{k}.json")
    with pytest.raises(CalibrationStale, match=says):
        found(tmp_path)


def test_one_is_taken_up_to_its_greatest_age(tmp_path):
    save_calibration(made(MAX_AGE - 60.0), tmp_path / "own.json")
    found(tmp_path)


@pytest.mark.parametrize(("kept", "now"), [("UR10e 0a1b", "UR10e 2c3d"), ("", "UR10e 2c3d"), ("UR10e 0a1b", "")])
def test_that_of_another_kinematics_of_the_arm_is_not_taken(tmp_path, kept: str, now: str):
    save_calibration(replace(made(), kinematics=kept), tmp_path / "own.json")
    with pytest.raises(CalibrationStale, match="another kinematics of the arm") as caught:
        find_calibration(tmp_path, DEVICES, CONFIGURATION, MAX_AGE, now)
    for word in (kept or "it does not say which", now or "none that is known", "30001", "run `cell calibrate`"):
        assert word in str(caught.value)
    assert find_calibration(tmp_path, DEVICES, CONFIGURATION, MAX_AGE, kept).kinematics == kept


def test_an_arm_that_was_not_asked_is_asked_again_before_anything_is_calibrated_anew(tmp_path):
    save_calibration(replace(made(), kinematics="UR10e 0a1b"), tmp_path / "own.json")
    why = "port 30001 of 10.0.0.5 sent none within 10 s"
    with pytest.raises(NotConnectedError, match=f"30001 was not read now: {why}; .*UR10e 0a1b.*connect anew") as caught:
        find_calibration(tmp_path, DEVICES, CONFIGURATION, MAX_AGE, "UR10e as drawn", why)
    assert "cell calibrate" not in str(caught.value)
    with pytest.raises(CalibrationStale, match="holds no calibration of these devices"):
        find_calibration(tmp_path / "none", DEVICES, CONFIGURATION, MAX_AGE, "UR10e as drawn", why)


def test_a_newer_one_that_does_not_fit_does_not_hide_the_own_one(tmp_path):
    own = made(5 * DAY)
    save_calibration(own, tmp_path / "own.json")
    save_calibration(made(configuration=OTHER), tmp_path / "a.json")
    save_calibration(of(rail="R2"), tmp_path / "z.json")
    assert found(tmp_path).made == pytest.approx(own.made)


spoilt_ways = pytest.mark.parametrize(
    "spoilt",
    [
        lambda data: json.dumps(data)[:2000],
        lambda data: json.dumps({**data, "format": data["format"] + 1}),
        lambda data: json.dumps({key: data[key] for key in data if key != "made"}),
    ],
    ids=["torn", "another format", "a number missing"],
)


@spoilt_ways
def test_a_file_of_another_format_or_with_a_number_missing_is_none(tmp_path, spoilt: Callable[[dict[str, Any]], str]):
    path = tmp_path / "own.json"
    save_calibration(made(), path)
    path.write_text(spoilt(json.loads(path.read_text(encoding="utf-8"))), encoding="utf-8")
    with pytest.raises(CalibrationStale, match=r"1 unreadable \(own\.json\)"):
        found(tmp_path)


@pytest.mark.parametrize(
    ("stored", "now"),
    [(("scan_camera", "laser"), ()), ((), ("scan_camera",)), (("scan_camera",), ("scan_camera", "rail"))],
)
def test_one_with_simulated_devices_is_none_of_the_real_ones_nor_the_other_way_round(
    tmp_path, stored: tuple[str, ...], now: tuple[str, ...]
):
    save_calibration(made(devices=marked(DEVICES, stored)), tmp_path / "own.json")
    with pytest.raises(CalibrationStale, match="no calibration of these devices"):
        find_calibration(tmp_path, marked(DEVICES, now), CONFIGURATION, MAX_AGE)
    assert find_calibration(tmp_path, marked(DEVICES, stored), CONFIGURATION, MAX_AGE).identities["arm"] == "A1"


def test_another_cells_edited_file_does_not_hide_the_own_one(tmp_path):
    save_calibration(made(), tmp_path / "own.json")
    save_calibration(of(arm="B7"), tmp_path / "other.json")
    edited(tmp_path / "other.json", "made", value=1.7e9)
    assert found(tmp_path).identities == DEVICES


def test_an_edited_copy_does_not_hide_the_intact_one(tmp_path):
    own = made()
    save_calibration(own, tmp_path / "own.json")
    save_calibration(made(0.5 * DAY), tmp_path / "copy.json")
    edited(tmp_path / "copy.json", "scan", "flange_from_camera", 0, 3, value=0.001)
    assert found(tmp_path).hash() == own.hash()
    (note,) = found(tmp_path).scan.unread
    assert "copy.json was changed after it was written: scan.flange_from_camera" in note
    assert note in found(tmp_path).summary()["notes"]


def test_an_edited_file_of_the_cell_itself_is_refused_beside_any_copy(tmp_path):
    path = tmp_path / f"{made().name}.json"
    save_calibration(made(), path)
    save_calibration(made(0.5 * DAY), tmp_path / "copy.json")
    edited(path, "scan", "flange_from_camera", 0, 3, value=0.001)
    with pytest.raises(CalibrationEdited, match="changed after it was written"):
        found(tmp_path)


@spoilt_ways
def test_an_older_copy_does_not_stand_in_for_the_cells_own_file_that_cannot_be_read(
    tmp_path, spoilt: Callable[[dict[str, Any]], str]
):
    path = tmp_path / f"{made().name}.json"
    save_calibration(made(), path)
    save_calibration(made(20 * DAY), tmp_path / "before.json")
    path.write_text(spoilt(json.loads(path.read_text(encoding="utf-8"))), encoding="utf-8")
    with pytest.raises(CalibrationStale, match=rf"{path.name} cannot be read as a calibration"):
        found(tmp_path)


@pytest.mark.parametrize("ending", ["-old", " (copy)", "_old"])
def test_a_copy_does_not_hide_what_the_cells_own_file_was_given_since(tmp_path, ending: str):
    own = made()
    save_calibration(own, tmp_path / f"{own.name}{ending}.json")
    own = replace(own, scan=replace(own.scan, refused="its shutter rolls"))
    save_calibration(own, tmp_path / f"{own.name}.json")
    with pytest.raises(CalibrationStale, match="holds no more, as was found since: its shutter rolls"):
        found(tmp_path)
