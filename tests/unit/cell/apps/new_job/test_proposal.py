"""Promises of `cell.apps.new_job.proposal`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.apps.new_job.make import make_job
from cell.apps.new_job.questions import Asker
from cell.config.cell_config import load_config
from drivers.errors import NotObservable
from tests.unit.cell.apps.new_job.meshes import relief


def test_tilted_sweeps_are_tried_where_straight_ones_leave_a_motion_open(tmp_path: Path) -> None:
    """A wave looks the same all along itself, from whichever side and however it is swept."""
    told: list[str] = []
    mesh = str(relief(tmp_path / "wave.stl", lambda x, y: 6 + 2 * np.sin(x / 6)))
    with pytest.raises(NotObservable):
        make_job(Asker({"mesh": mesh}, None, told.append), load_config(None), tmp_path, False)
    assert "choosing sweeps from the other side as well …" in told
    assert any("straight sweeps leave a motion of the surface open: tilted ones" in text for text in told), told
