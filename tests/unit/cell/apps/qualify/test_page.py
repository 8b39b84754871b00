"""The tables that people read, and the page: one file that asks nobody for anything, what was typed escaped."""

import re

import cv2
import numpy as np

from cell.apps.qualify import page
from cell.apps.qualify.answer import compare
from cell.apps.qualify.page import PAGE, comparison_tables, plots_of, tables_of, write_page
from tests.support.qualified import row
from tests.unit.cell.apps.qualify.test_answer import answer, some


def test_every_row_has_all_columns_and_units():
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


def test_of_many_worst_worlds_some_are_shown():
    bad = answer(*(row(seed, "refused", reason="dark") for seed in range(1, 31)))
    table = next(one for one in tables_of(bad) if one.title.startswith("the worst worlds"))
    assert (table.title, len(table.rows)) == (f"the worst worlds, {page.MOST_WORLDS} of 30", page.MOST_WORLDS)


def test_a_comparison_tells_its_signs():
    made = list(comparison_tables(compare([row(1, error_mm=0.2), row(2, "refused")], [row(1), row(2)])))
    told = {row[0]: row[1:] for row in made[0].rows}
    assert told["yield"][0] == "-50.0 %"
    assert told["place error, largest of 45 points"] == ("+0.1 mm", "", "1")
    assert made[1].rows == [("2", "placed", "refused", "")]


def test_a_page_holds_plots_tables_and_commands(tmp_path):
    rows = [*(row(seed, error_mm=0.01 * seed) for seed in range(1, 30)), row(30, "refused", reason="<b>dark</b>")]
    told = answer(*rows)
    assert write_page(tmp_path, told, rows) == tmp_path / PAGE
    text = (tmp_path / PAGE).read_text(encoding="utf-8")
    assert not re.findall(r"(?:src|href)=\"(?!data:)", text)
    assert len(re.findall(r"data:image/png;base64,", text)) == 3
    assert "&lt;b&gt;dark&lt;/b&gt;" in text
    assert "<b>dark" not in text
    for words in (told.line, "repeat 30", "place error, largest of 45 points", "Cycle time"):
        assert words in text


def test_plots_are_pictures_also_of_one_world_and_of_none_that_placed():
    for rows in ([row(1)], [row(1, "refused")]):
        for plot in plots_of(answer(*rows), rows):
            image = cv2.imdecode(np.frombuffer(plot.png, np.uint8), cv2.IMREAD_COLOR)
            assert image.std() > 1.0, plot.title
