"""Promises of `cell.apps.new_job.proposal`."""

import numpy as np
import pytest

from cell.apps.new_job.make import make_job
from cell.apps.new_job.questions import Asker
from cell.config.cell_config import load_config
from drivers.errors import NotObservable
from tests.unit.cell.apps.new_job.meshes import dish, from_options, relief


def test_a_disc_is_refused_by_its_free_turn_however_coarsely_it_is_drawn(tmp_path):
    """Facets of the drawing are no relief of the part."""
    with pytest.raises(NotObservable, match="rotation about the z axis") as refused:
        from_options(tmp_path, mesh=str(dish(tmp_path / "dish.stl", 12)))
    assert "--prior-angle" in str(refused.value) and "flat tops do not" in str(refused.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dish-refused.png", "dish.stl"]


def test_what_takes_long_is_told_while_it_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr("cell.apps.new_job.questions.PROGRESS_S", 0.0)
    monkeypatch.setattr("cell.apps.new_job.make.draw_proposal", lambda *_: None)
    told: list[str] = []
    mesh = str(relief(tmp_path / "wave.stl", lambda x, y: 6 + 2 * np.sin(x / 6)))
    with pytest.raises(NotObservable):
        make_job(Asker({"mesh": mesh}, None, told.append), load_config(None), tmp_path, False)
    for words in ("triangles to look at …", "straight sweeps see …", "tilted sweep 8 of 8", "tells most", "other side"):
        assert any(words in text for text in told), told
