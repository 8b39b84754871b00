"""The pages that `python docs/generate.py` writes are as it would write them now."""

from __future__ import annotations

import importlib.util
from typing import Any

import pytest

from tests.support import ROOT


def generator() -> Any:
    """`docs/generate.py` as a module."""
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PAGES = generator().PAGES


@pytest.mark.parametrize("page", PAGES)
def test_a_generated_page_is_current(page: str) -> None:
    there = (ROOT / "docs" / page).read_text(encoding="utf-8")
    assert there == PAGES[page](), "run `python docs/generate.py`"


def test_fault_codes_have_what_happened_and_what_to_do() -> None:
    faults = generator().causes()
    assert {"rail.reset", "arm.protective_stop", "camera.late_readings", "laser.relay"} <= faults.keys()
    what, who, hint = faults["rail.reset"]
    assert any("lost its zero" in text for text in what) and who == {"the program"} and any("Home" in h for h in hint)
