"""`cell watch` at a served cell: what is seen of a cell that another process runs."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cell.apps.watch import watching
from cell.config.cell_config import load_config
from drivers.clock import Clock
from tests.support.wire.cells import served, started

pytestmark = pytest.mark.wire


def until(true: Callable[[], bool], timeout: float, what: str) -> None:
    end = time.monotonic() + timeout
    while not true():
        assert time.monotonic() < end, f"did not come: {what}"
        Clock().sleep(0.02)


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("cell")
    with served(folder, "--speed", "1"):
        yield folder


@pytest.mark.campaign
def test_a_cell_that_another_process_runs_is_watched(cell: Path) -> None:
    config = load_config(cell / "sim.toml")
    with started("home", "-c", str(cell / "sim.toml"), folder=cell) as home:
        with watching(config, cell / config.cell.runs, whole=False) as watch:
            seen: list[str] = []
            until(lambda: seen.append("\n".join(watch.lines())) or "homing" in seen[-1], 90.0, "the run")
            until(lambda: seen.append("\n".join(watch.lines())) or home.poll() is not None, 90.0, "its end")
            assert home.poll() == 0, home.communicate()[1]
            until(lambda: seen.append("\n".join(watch.lines())) or "nothing goes on" in seen[-1], 10.0, "rest")
            until(lambda: seen.append("\n".join(watch.lines())) or "  deg" in seen[-1], 10.0, "the arm")
            last = seen[-1]
        joints = [float(value) for value in re.findall(r"  deg +(.*)", last)[0].split()]
        assert joints == pytest.approx([90.0, -100.0, 100.0, -90.0, -90.0, 0.0], abs=0.02)
        # It was seen on its way, beside its limits, and the rail was left to its only user.
        assert len({re.findall(r"  deg +(.*)", text)[0] for text in seen if "  deg" in text}) > 3
        assert any("safety normal, moves" in text for text in seen)
        assert any("rail     not looked at, its line has one user: process" in text for text in seen)
        assert "nothing goes on" in last
    with watching(config, cell / config.cell.runs, whole=True) as watch:
        until(lambda: "rail     homed, stands at 0.000 mm" in "\n".join(watch.lines()), 10.0, "the rail")
