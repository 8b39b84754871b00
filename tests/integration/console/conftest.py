"""One cell on the virtual clock for the tests of the desk and of the console."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from cell.run.session.supervisor import Cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    """Its runs lie in a folder of its own."""
    folder = tmp_path_factory.mktemp("cell")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        opened = Cell.open(sim="all", seed=3, clock="virtual")
    with opened:
        yield opened
