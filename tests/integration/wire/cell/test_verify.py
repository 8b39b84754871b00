"""`cell calibrate verify` on the simulated cell: a good calibration passes, a disturbed file is told."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.support.wire.cells import cell

pytestmark = [pytest.mark.wire, pytest.mark.campaign]


def test_verify_tells_a_disturbed_calibration_from_a_good_one(place: Path, tmp_path: Path) -> None:
    world = ("--sim", "all", "--seed", "3", "--json")
    shutil.copytree(place / "calibrations", tmp_path / "calibrations")
    done = cell("calibrate", "verify", *world, folder=tmp_path, timeout=400.0)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout)["good"]

    (file,) = (tmp_path / "calibrations").glob("*.json")
    stored: dict[str, Any] = json.loads(file.read_text())
    stored["scan"]["flange_from_camera"][0][3] += 0.2e-3
    file.write_text(json.dumps(stored))
    done = cell("calibrate", "verify", *world, folder=tmp_path, timeout=400.0)
    assert (done.returncode, "changed after it was written: scan.flange_from_camera" in done.stderr) == (1, True)
    done = cell("calibrate", "accept", file.stem, "--why", "a mount that slipped", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    done = cell("calibrate", "verify", *world, folder=tmp_path, timeout=400.0)
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)
    assert not found["good"]
    assert "scan camera" in found["suspects"][0]["part"]
    assert found["suspects"][0]["place_error_mm"] > 0.05
