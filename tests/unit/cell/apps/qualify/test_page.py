"""The page: one file that asks nobody for anything, with its plots, its tables, and what was typed escaped."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np

from cell.apps.qualify.page import PAGE, plots_of, write_page
from tests.support.qualified import row
from tests.unit.cell.apps.qualify.test_answer import answer


def test_a_page_holds_plots_tables_and_commands(tmp_path: Path) -> None:
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


def test_plots_are_pictures_also_of_one_world_and_of_none_that_placed() -> None:
    for rows in ([row(1)], [row(1, "refused")]):
        for plot in plots_of(answer(*rows), rows):
            image = cv2.imdecode(np.frombuffer(plot.png, np.uint8), cv2.IMREAD_COLOR)
            assert image is not None
            assert image.std() > 1.0, plot.title
