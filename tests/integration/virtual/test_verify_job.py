"""`cell calibrate verify` and `accept`, typed: a good calibration passes, a disturbed one is told with its part."""

import json
from functools import partial
from pathlib import Path

import pytest

from cell import Cell
from drivers.errors import CalibrationStale
from tests.support import Typed


def test_verify_tells_a_disturbed_calibration_from_a_good_one(calibrated_folder: Path, monkeypatch, typed: Typed):
    (file,) = (calibrated_folder / "calibrations").glob("*.json")
    monkeypatch.setattr(Cell, "open", partial(Cell.open, clock="virtual"))
    verify = ("calibrate", "verify", "--sim", "all", "--seed", "2", "--json")
    code, out, _ = typed(*verify)
    assert (code, json.loads(out)["good"]) == (0, True)
    stored = json.loads(file.read_text())
    stored["scan"]["flange_from_camera"][0][3] += 0.2e-3
    file.write_text(json.dumps(stored))
    code, _, error = typed(*verify)
    assert (code, "was changed after it was written: scan.flange_from_camera. " in error) == (1, True), error
    with Cell.open(sim="all", seed=2) as cell, pytest.raises(CalibrationStale, match="was changed after"):
        cell.run()
    assert typed("calibrate", "accept", file.stem, "--why", " ")[0] == 2
    code, out, _ = typed("calibrate", "accept", file.stem, "--why", "a mount that slipped", "--by", "Ann", "--json")
    edit = json.loads(out)
    assert (code, edit["who"], edit["why"]) == (0, "Ann", "a mount that slipped")
    assert edit["changed"] == ["scan.flange_from_camera"]
    code, out, _ = typed(*verify)
    found = json.loads(out)
    assert (code, found["good"]) == (1, False)
    assert "scan camera" in found["suspects"][0]["part"]
    assert found["suspects"][0]["place_error_mm"] > 0.05


@pytest.mark.campaign
@pytest.mark.usefixtures("here")
def test_cells_that_nobody_touched_are_called_good():
    alarms, alarmed, changes = 0, 0, 0
    for seed in range(1, 21):
        with Cell.open(sim="all", seed=seed, clock="virtual") as cell:
            cell.calibrate()
            checks = [cell.verify() for _ in range(3)]
        bad = sum(not check.good for check in checks)
        alarms, alarmed, changes = alarms + bad, alarmed + (bad > 0), changes + sum(c.verdict.changed for c in checks)
    # Checks of one calibration share its error, so its worlds are counted as well: 5 % of 60 and of 20.
    assert (alarms <= 3, alarmed <= 1) == (True, True)
    assert changes <= 6
