"""Promises of `cell.apps.new_job.questions`."""

from __future__ import annotations

import pytest

from cell.apps.new_job.questions import Asker, checked, told_by_size
from cell.config.job import SurfaceSection
from drivers.errors import ConfigError


@pytest.mark.parametrize(("longest", "unit"), [(60.0, "mm"), (0.14, "m"), (5.0, "inch")])
def test_a_unit_is_told_by_the_size_where_one_alone_makes_sense(longest: float, unit: str) -> None:
    found, words = told_by_size(longest)
    assert found == unit and f"taken as {unit}" in words


@pytest.mark.parametrize("longest", [16.0, 600.0, 0.001])
def test_a_unit_that_the_size_does_not_tell_is_asked_for(longest: float) -> None:
    with pytest.raises(ConfigError, match="--unit"):
        told_by_size(longest)


def test_a_wrong_answer_is_told_and_asked_again() -> None:
    answers = iter(["3", "200 mm", "0.5 mm"])
    told: list[str] = []
    asker = Asker({}, lambda question, default: next(answers), told.append)
    assert asker.get("prior", "How exactly", "3 mm", checked(SurfaceSection, "prior_sigma")) == 0.0005
    assert "no unit" in told[0] and "0.01 to 100 mm" in told[0] and "0.01 to 100 mm" in told[1]
    with pytest.raises(ConfigError, match=r"--prior: .*0\.01 to 100 mm"):
        Asker({"prior": "200 mm"}, None, told.append).get("prior", "", "3 mm", checked(SurfaceSection, "prior_sigma"))
