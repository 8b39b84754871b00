"""Promises of `cell.apps.new_job.observability`."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.errors import NotObservable
from tests.unit.cell.apps.new_job.meshes import dish, from_options


def test_a_disc_is_refused_by_its_free_turn_however_coarsely_it_is_drawn(tmp_path: Path) -> None:
    """Facets of the drawing are no relief of the part."""
    with pytest.raises(NotObservable, match="rotation about the z axis") as refused:
        from_options(tmp_path, mesh=str(dish(tmp_path / "dish.stl", 12)))
    assert "--prior-angle" in str(refused.value) and "flat tops do not" in str(refused.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dish-refused.png", "dish.stl"]
