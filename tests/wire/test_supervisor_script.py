"""The script that the README prints runs as printed, on a machine that has seen nothing yet."""

from __future__ import annotations

import pytest

from tests.wire.cells import Supervised

pytestmark = pytest.mark.wire


def test_the_supervisor_script_runs_as_printed(supervised: Supervised) -> None:
    assert supervised.printed.startswith("placed")
    assert "mean D" in supervised.printed
