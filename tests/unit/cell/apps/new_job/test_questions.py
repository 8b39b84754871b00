"""Promises of `cell.apps.new_job.questions`."""

from __future__ import annotations

import pytest

from cell.apps.new_job.questions import Asker, checked
from cell.config.job import SurfaceSection
from drivers.errors import ConfigError


def test_a_wrong_answer_is_told_and_asked_again() -> None:
    answers = iter(["3", "200 mm", "0.5 mm"])
    told: list[str] = []
    asker = Asker({}, lambda question, default: next(answers), told.append)
    assert asker.get("prior", "How exactly", "3 mm", checked(SurfaceSection, "prior_sigma")) == 0.0005
    assert "no unit" in told[0] and "0.01 to 100 mm" in told[0] and "0.01 to 100 mm" in told[1]
    with pytest.raises(ConfigError, match=r"--prior: .*0\.01 to 100 mm"):
        Asker({"prior": "200 mm"}, None, told.append).get("prior", "", "3 mm", checked(SurfaceSection, "prior_sigma"))
