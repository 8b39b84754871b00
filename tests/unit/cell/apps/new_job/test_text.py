"""Promises of `cell.apps.new_job.text`."""

from __future__ import annotations

import pytest

from cell.apps.new_job.text import told_by_size
from drivers.errors import ConfigError


@pytest.mark.parametrize(("longest", "unit"), [(60.0, "mm"), (0.14, "m"), (5.0, "inch")])
def test_a_unit_is_told_by_the_size_where_one_alone_makes_sense(longest: float, unit: str) -> None:
    found, words = told_by_size(longest)
    assert found == unit and f"taken as {unit}" in words


@pytest.mark.parametrize("longest", [16.0, 600.0, 0.001])
def test_a_unit_that_the_size_does_not_tell_is_asked_for(longest: float) -> None:
    with pytest.raises(ConfigError, match="--unit"):
        told_by_size(longest)
