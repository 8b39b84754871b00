"""The packages that tutorials and docs/how-to/makes.md print are ones that the cell takes."""

import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from cell import PLACE, BoardFix, Kind, Make, RefusedError, makes
from cell.config.cell_config import default_toml, load_config
from drivers.arm.make import ArmOutputClawConfig
from tests.project.test_readme import block


def defined(page: str, which: str, language: str = "py") -> Any:
    """What the first block of code of a page defines under this name."""
    names: dict[str, Any] = {"__name__": "printed"}
    exec(compile(block(language, page), page, "exec", dont_inherit=True), names)
    return names[which]


def entry_points(page: str) -> dict[str, dict[str, str]]:
    """The entry points of the `pyproject.toml` that a page prints, by group."""
    found: dict[str, dict[str, str]] = tomllib.loads(block("toml", page))["project"]["entry-points"]
    return found


class Context:
    """What a step of the tutorial asks of its context."""

    def __init__(self, leaning: float) -> None:
        turn = np.radians(90.0 - leaning)
        self.fix = type("Fix", (), {})()
        self.fix.base_from_board = type("Pose", (), {"rotation": np.diag([1.0, 1.0, np.cos(turn)])})()

    def made(self, kind: type) -> Any:
        assert kind is BoardFix
        return self.fix

    def progress(self, fraction: float, text: str) -> None:
        assert 0 <= fraction <= 1 and "deg" in text


def test_the_step_of_the_tutorial_is_one_more_and_refuses_what_leans():
    page = "docs/tutorials/own-step.md"
    kind: Kind = defined(page, "KIND")
    assert entry_points(page) == {"assembly_cell.kinds": {kind.name: "lean_step:KIND"}}
    assert kind.names == (*PLACE.names[:2], "see_lean", *PLACE.names[2:])
    step = kind.steps[2]
    made: Any = step.work(None, Context(45.0))  # type: ignore[arg-type]
    assert made.summary() == {"lean_deg": 45.0}
    with pytest.raises(RefusedError, match=r"leans by 70\.00 deg \(allowed: at most 60\.0 deg\)"):
        step.work(None, Context(70.0))  # type: ignore[arg-type]


def test_the_make_of_the_tutorial_is_taken(tmp_path, monkeypatch):
    page = "docs/tutorials/own-make.md"
    ((name, where),) = entry_points(page)["assembly_cell.devices"].items()
    make: Make[Any, Any] = defined(page, "MAKE")
    assert (name, where) == (f"{make.kind}.{make.name}", "acme_claw:MAKE")
    monkeypatch.setattr(EntryPoint, "load", lambda self: make)
    monkeypatch.setattr(makes, "entry_points", lambda group: [EntryPoint(name, where, group)])
    file = tmp_path / "cell.toml"
    before, claw, after = default_toml().partition("[claw]")
    file.write_text(before + claw + after.replace("arm_output", "acme", 1), encoding="utf-8")
    config = load_config(file)
    assert config.make("claw") is make and isinstance(config.claw, ArmOutputClawConfig) and config.claw.output == 1


def test_the_make_of_the_how_to_is_a_record_and_a_function():
    make: Make[Any, Any] = defined("docs/how-to/makes.md", "MAKE", "python")
    assert (make.kind, make.name, make.record.ADDRESS, make.calibrated) == ("rail", "acme", "port", {"belt"})


def test_the_script_of_the_tutorial_makes_a_mesh(here: Path):
    defined("docs/tutorials/own-part.md", "faces")
    mesh = trimesh.load_mesh(here / "saddle.ply")
    assert mesh.extents[:2] == pytest.approx([60.0, 30.0])
