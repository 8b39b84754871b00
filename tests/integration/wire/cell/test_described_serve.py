"""A served cell is the one of its files, its own file describes it, and its claw is filled as a person would."""

from pathlib import Path

import pytest

from cell.config.cell_config import load_config
from tests.integration.virtual.test_described_jobs import SADDLE
from tests.support import Typed
from tests.support.described_cells import described, write_saddle
from tests.support.wire.cells import ask, served

pytestmark = pytest.mark.wire


def test_a_cell_of_ones_own_is_served_and_filled_again(here: Path, typed: Typed):
    config, own = described(here, {"rail": {"lead": '"5 mm"'}, "cell": {"name": '"Zelle é"'}}, SADDLE)
    write_saddle(here / "saddle.ply")
    with served(here, "-c", config.name, "-j", own.name) as endpoints:
        assert endpoints["surface"] == "saddle"
        told = load_config(here / "sim.toml")
        assert (told.rail.lead, told.cell.name) == (0.005, "Zelle é")
        assert told.arm.place == endpoints["arm"]["address"]
        assert told.calibration_hash() == load_config(config).calibration_hash()
        code, _, error = typed("sim", "fill", "-c", "sim.toml", "-j", "pot")
        assert code == 0, error
        truth = ask(endpoints, op="truth")["truth"]
        assert (truth["surface"]["name"], truth["part"]["held"]) == ("pot", True)
        text = (here / "sim.toml").read_text(encoding="utf-8")
        (here / "other.toml").write_text(text.replace('lead = "5 mm"', 'lead = "4 mm"'), encoding="utf-8")
        code, _, error = typed("sim", "fill", "-c", "other.toml")
    assert code == 1
    assert "another cell than the one that is simulated" in error
