"""`cell jog rail` goes on from where the rail stands, program after program; it homes only a rail that is not homed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.wire.cells import ask, cell, served

pytestmark = pytest.mark.wire


def jogged(folder: Path) -> dict[str, str]:
    done = cell("jog", "rail", "+5mm", "-c", "sim.toml", "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    answer: dict[str, str] = json.loads(done.stdout)
    return answer


def test_two_jogs_by_5_mm_end_at_10_mm_and_one_after_a_reset_says_that_it_homed(tmp_path: Path) -> None:
    with served(tmp_path, "--level", "ideal") as endpoints:

        def carriage() -> float:
            place: float = ask(endpoints, op="truth")["truth"]["rail"]["carriage"]
            return place

        assert "homing" in jogged(tmp_path)
        assert carriage() == pytest.approx(0.005, abs=1e-5)
        assert "homing" not in jogged(tmp_path)
        assert carriage() == pytest.approx(0.010, abs=1e-5)
        ask(endpoints, op="fault", name="rail.reset")
        assert "homing" in jogged(tmp_path)
        assert carriage() == pytest.approx(0.005, abs=1e-5)
