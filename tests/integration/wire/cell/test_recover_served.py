"""Out of a fault over the wires: `cell recover`, a question of `cell home`, an arm that froze and was lost."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cell import Cell
from cell.run.folder import awaited_word
from drivers.clock import Clock
from drivers.errors import DeviceFault
from statemachine.journal import request
from tests.support.wire.cells import ask, cell, served, started, wait_for_step

pytestmark = pytest.mark.wire


@pytest.fixture(scope="module")
def serving(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, dict[str, Any]]]:
    folder = tmp_path_factory.mktemp("cell")
    with served(folder, "--seed", "3", "--level", "ideal") as endpoints:
        (folder / "cell.toml").write_text((folder / "sim.toml").read_text(encoding="utf-8"), encoding="utf-8")
        yield folder, endpoints


def test_an_idle_protective_stop_is_unlocked_by_a_person_who_is_named(serving: tuple[Path, dict[str, Any]]) -> None:
    folder, endpoints = serving
    ask(endpoints, op="fault", name="arm.protective_stop")
    unnamed = cell("recover", folder=folder)
    assert unnamed.returncode == 2 and "--by NAME" in unnamed.stderr
    assert ask(endpoints, op="truth")["truth"]["arm"]["safety"] == "protective_stop"
    done = cell("recover", "--by", "Ann", folder=folder)
    assert (done.returncode, ask(endpoints, op="truth")["truth"]["arm"]["safety"]) == (0, "normal"), done.stderr


def test_a_homing_that_stopped_goes_on_after_cell_confirm(serving: tuple[Path, dict[str, Any]]) -> None:
    folder, endpoints = serving
    with started("home", "arm", folder=folder) as homing:
        run = wait_for_step(folder, "homing", homing)
        ask(endpoints, op="fault", name="arm.protective_stop")
        while (asked := awaited_word(run)) is None:
            assert homing.poll() is None
            Clock().sleep(0.05)
        request(run, "confirm", "Ann", asked.number)
        assert homing.wait(60.0) == 0
        assert homing.stderr is not None and "waiting for a person, question 1" in homing.stderr.read()


def test_an_arm_that_froze_is_used_again_by_the_same_program(tmp_path: Path) -> None:
    """Its link is lost after 1.5 s of silence: a person's word connects it again."""
    with started("sim", "serve", "--json", "--speed", "1", "--config-out", "cell.toml", folder=tmp_path) as sim:
        assert sim.stdout is not None
        sim.stdout.readline()
        with Cell.open(tmp_path / "cell.toml", only=("arm", "vehicle")) as opened:
            sim.send_signal(signal.SIGSTOP)
            Clock().sleep(4.0)
            with pytest.raises(DeviceFault, match="was lost"):
                opened.devices.arm.state()
            sim.send_signal(signal.SIGCONT)
            opened.recover("Ann")
            opened.home("arm")
            assert opened.devices.arm.state().controlled
