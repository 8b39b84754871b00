"""The tables that people read."""

from __future__ import annotations

from cell.apps.qualify import tables
from cell.apps.qualify.compare import compare
from cell.apps.qualify.tables import comparison_tables, tables_of
from tests.support.qualified import row
from tests.unit.cell.apps.qualify.test_answer import answer, some


def test_every_row_has_all_columns_and_units() -> None:
    made = {table.title: table for table in tables_of(some())}
    for table in made.values():
        assert {len(row) for row in table.rows} <= {len(table.columns)}, table.title
    told = {row[0]: row[1:] for row in made["how 10 worlds of nominal ended"].rows}
    assert told["placed"] == ("6", "60.0 %", "[26.2, 87.8] %")
    assert told["placed outside the tolerance, unnoticed"][0] == "0"
    figures = {row[0]: row for row in made["figures beside their limits, the lowest Cpk first"].rows}
    assert figures["place error, largest of 45 points"][5:7] == ("≤ 0.6", "mm")
    assert figures["surface covered"][5:7] == ("≥ 35", "%")
    reasons = made["why worlds did not place"].rows
    assert reasons[0] == ("2", "refused", "invert_pose", "the fit is … mm off, allowed are … mm", "7")


def test_of_many_worst_worlds_some_are_shown() -> None:
    bad = answer(*(row(seed, "refused", reason="dark") for seed in range(1, 31)))
    table = next(one for one in tables_of(bad) if one.title.startswith("the worst worlds"))
    assert table.title == f"the worst worlds, {tables.MOST_WORLDS} of 30"
    assert len(table.rows) == tables.MOST_WORLDS


def test_a_comparison_tells_its_signs() -> None:
    made = list(comparison_tables(compare([row(1, error_mm=0.2), row(2, "refused")], [row(1), row(2)])))
    told = {row[0]: row[1:] for row in made[0].rows}
    assert told["yield"][0] == "-50.0 %"
    assert told["place error, largest of 45 points"] == ("+0.1 mm", "", "1")
    assert made[1].rows == [("2", "placed", "refused", "")]
