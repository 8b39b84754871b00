"""One cell on the virtual clock and what pages ask of it, and one server without a cell."""

import threading
from collections.abc import Iterator

import pytest

from cell.apps.console.host.console import Console
from cell.apps.console.host.controller import ConsoleController
from cell.run.session.supervisor import Cell
from tests.support.console.server import Served, serving


@pytest.fixture(scope="module")
def cell(tmp_path_factory) -> Iterator[Cell]:
    """Its runs lie in a folder of its own."""
    folder = tmp_path_factory.mktemp("cell")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        opened = Cell.open(sim="all", seed=3, clock="virtual")
    with opened:
        yield opened


@pytest.fixture
def controller(cell: Cell) -> Iterator[ConsoleController]:
    made = ConsoleController(cell, "pot", lambda client, words: None)
    made.holders.joined("c1")
    made.holders.joined("c2")
    yield made
    made.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[Served]:
    with serving(tmp_path_factory.mktemp("runs")) as served:
        yield served


@pytest.fixture
def gone() -> threading.Event:
    return threading.Event()


@pytest.fixture
def console(cell: Cell, gone: threading.Event) -> Iterator[Console]:
    with Console(cell, "pot", gone=gone.set) as made:
        yield made
    if not cell.devices.gate.is_open:
        cell.clear_stop("the test")
