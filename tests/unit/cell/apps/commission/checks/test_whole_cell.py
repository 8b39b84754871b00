"""The first check of a cell, and a whole commissioning up to its first part."""

from contextlib import closing

import pytest

from cell.apps.commission.sequence import by_name
from tests.support.commissioning import Shown, commissioned, files, opened


@pytest.mark.parametrize("clear", [True, False])
def test_every_device_answers_is_named_and_well_and_a_person_has_looked_round(tmp_path, clear: bool):
    files(tmp_path)
    made = opened(tmp_path, Shown(), lambda text: clear)
    with closing(made.workplace):
        result = made._once(by_name("links"))
    assert result.verdict == ("good" if clear else "wrong")
    assert [row.what for row in result.readings if not row.ok] == ([] if clear else ["a person has looked round"])
    assert len(result.notes) >= 7 and all("no identity" not in note for note in result.notes)


@pytest.mark.campaign
def test_a_cell_on_which_nothing_is_wrong_is_commissioned_up_to_its_first_part(tmp_path):
    files(tmp_path, lambda text: text)
    good, shown = commissioned(tmp_path, "job_part")
    assert good
    assert shown.found == []
