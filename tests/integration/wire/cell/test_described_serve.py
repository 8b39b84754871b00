"""A served cell is the one of its files, its own file describes it, and its claw is filled as a person would."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cell.config.cell_config import load_config
from tests.integration.virtual.test_described_jobs import SADDLE
from tests.support.described_cells import described, write_saddle
from tests.support.wire.cells import ask, served

pytestmark = pytest.mark.wire


def test_a_cell_of_ones_own_is_served_and_filled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, typed: Callable[..., tuple[int, str, str]]
) -> None:
    monkeypatch.chdir(tmp_path)
    config, own = described(tmp_path, {"rail": {"lead": '"5 mm"'}, "cell": {"name": '"Zelle é"'}}, SADDLE)
    write_saddle(tmp_path / "saddle.ply")
    with served(tmp_path, "-c", config.name, "-j", own.name) as endpoints:
        assert endpoints["surface"] == "saddle"
        told = load_config(tmp_path / "sim.toml")
        assert (told.rail.lead, told.cell.name) == (0.005, "Zelle é")
        assert told.arm.place == endpoints["arm"]["address"]
        assert told.calibration_hash() == load_config(config).calibration_hash()
        code, _, error = typed("sim", "fill", "-c", "sim.toml", "-j", "pot")
        assert code == 0, error
        truth = ask(endpoints, op="truth")["truth"]
        assert (truth["surface"]["name"], truth["part"]["held"]) == ("pot", True)
        text = (tmp_path / "sim.toml").read_text(encoding="utf-8")
        (tmp_path / "other.toml").write_text(text.replace('lead = "5 mm"', 'lead = "4 mm"'), encoding="utf-8")
        code, _, error = typed("sim", "fill", "-c", "other.toml")
    assert code == 1
    assert "another cell than the one that is simulated" in error
