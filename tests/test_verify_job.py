"""`Cell.verify` on the simulated cell: a good calibration passes, a disturbed one is told with its part."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cell import Cell
from cell.calibration.store import save_calibration
from cell.lab.bench.whole_job import JobRecord


def test_verify_tells_a_disturbed_calibration_from_a_good_one(
    placed_pot: JobRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert placed_pot.calibration is not None
    file = tmp_path / "calibrations" / f"{placed_pot.calibration.name}.json"
    save_calibration(placed_pot.calibration, file)
    monkeypatch.chdir(tmp_path)
    with Cell.open(sim="all", seed=2, clock="virtual") as cell:
        assert cell.verify().good
    stored = json.loads(file.read_text())
    stored["scan"]["flange_from_camera"][0][3] += 0.2e-3
    file.write_text(json.dumps(stored))
    with Cell.open(sim="all", seed=2, clock="virtual") as cell:
        found = dict(cell.verify().summary())
    assert not found["good"]
    assert "scan camera" in found["suspects"][0]["part"]
    assert found["suspects"][0]["place_error_mm"] > 0.05
