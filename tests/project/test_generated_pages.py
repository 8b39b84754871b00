"""The pages that `python docs/generate.py` writes are as it would write them now."""

import importlib.util
import re
from typing import Any

import pytest

import cell
from tests.support import ROOT


def generator() -> Any:
    """`docs/generate.py` as a module."""
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


GENERATOR = generator()
PAGES = GENERATOR.PAGES


@pytest.mark.parametrize("page", PAGES)
def test_a_generated_page_is_current(page: str):
    there = (ROOT / "docs" / page).read_text(encoding="utf-8")
    assert there == PAGES[page](), "run `python docs/generate.py`"


def test_fault_codes_have_what_happened_and_what_to_do():
    faults = GENERATOR.causes()
    assert {"rail.reset", "arm.protective_stop", "camera.late_readings", "laser.relay"} <= faults.keys()
    what, who, hint = faults["rail.reset"]
    assert any("lost its zero" in text for text in what) and who == {"the program"} and any("Home" in h for h in hint)


def test_a_protective_stop_is_not_cleared_without_a_person():
    (row,) = [line for line in GENERATOR.faults().splitlines() if line.startswith("| `arm.protective_stop`")]
    assert "after a person confirms" in row


def test_the_page_of_the_public_python_has_every_name_of_the_door():
    page = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^::: cell\.(\w+)$", page, re.MULTILINE)) == sorted(cell.__all__)
    assert len(cell.__all__) <= 60
