"""A batch that a page began: counted part by part, held between two parts, ended there by the page or by a stop."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cell import Cell
from cell.apps.console.host.controller import ConsoleController
from drivers.errors import ConfigError, InterlockError
from tests.support import until
from tests.support.console.server import refusal
from tests.support.described_cells import described, pose

MOVED = {"scan_camera": {"flange_from_camera": pose((92, -50, 80), (0, 0, 90))}}
"""The scan head was bumped since the calibration: each part is refused, and soon."""


@pytest.fixture
def controller(calibrated_folder: Path) -> Iterator[ConsoleController]:
    config, own = described(calibrated_folder, None, None)
    own.write_text(f'{own.read_text()}\n[batch]\non_refusal = "skip"\n')
    true = described(calibrated_folder / "true", MOVED)[0]
    with Cell.open(config, sim="all", clock="virtual", seed=2, job=own, truth=true) as cell:
        made = ConsoleController(cell, "own", lambda client, words: None)
        made.holders.joined("c1")
        made.do("c1", {"do": "hold", "name": "Ann"})
        yield made
        made.close()


def shown(controller: ConsoleController) -> dict[str, Any]:
    return controller.queue.as_dict() or {}


def becomes(controller: ConsoleController, state: str) -> bool:
    return until(lambda: shown(controller).get("state") == state, seconds=60)


def test_a_queue_holds_between_two_parts_goes_on_and_ends_when_it_is_told(controller: ConsoleController):
    assert controller.queue.as_dict() is None
    assert isinstance(refusal(controller, "c1", do="queue", parts="hold"), InterlockError)
    assert isinstance(refusal(controller, "c1", do="start", count=3, until="board_photo"), ConfigError)
    controller.do("c1", {"do": "start", "count": 3})
    assert "holds after this part" in controller.do("c1", {"do": "queue", "parts": "hold"})["text"]
    assert becomes(controller, "holding")
    first = shown(controller)
    assert (first["part"], first["count"], first["wanted"]) == (1, 3, "hold")
    assert {name: n for name, n in first["counts"].items() if n} == {"refused": 1, "not tried": 2}
    assert controller.cell.current is None
    assert controller.queue._run is not None and controller.queue._run.control.held_s > 0.0, "people may come near"
    for words in ({"do": "start"}, {"do": "start", "count": 2}, {"do": "resume"}):
        assert "a batch of own is going on" in str(refusal(controller, "c1", **words))
    controller.do("c1", {"do": "queue", "parts": "run"})
    assert until(lambda: controller.cell.current is not None, seconds=10)
    controller.do("c1", {"do": "queue", "parts": "end"})
    assert becomes(controller, "ended")
    last = shown(controller)
    assert (last["counts"]["refused"], last["counts"]["not tried"]) == (2, 1)
    assert last["reason"] == "after part 2, as asked"
    assert isinstance(refusal(controller, "c1", do="queue", parts="run"), InterlockError)


def test_a_stop_ends_a_queue_that_holds(controller: ConsoleController):
    controller.do("c1", {"do": "start", "count": 2})
    controller.do("c1", {"do": "queue", "parts": "hold"})
    assert becomes(controller, "holding")
    controller.cell.stop()
    assert becomes(controller, "ended")
    assert shown(controller)["counts"]["not tried"] == 1
    assert shown(controller)["reason"].startswith("after part 1: the cell was stopped before the job began")
