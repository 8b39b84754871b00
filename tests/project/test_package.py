"""What a script can take from `cell` itself, and what the command line says of itself."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter

import pytest

import cell
from drivers import errors
from tests.support import ROOT

ROOMS = ("cell", "drivers", "statemachine", "sim_backends", "lab")


def test_every_error_of_the_tree_is_in_the_package() -> None:
    tree = [
        name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, errors.CellError)
    ]
    assert len(tree) > 10
    for name in tree:
        assert getattr(cell, name) is getattr(errors, name)
        assert name in cell.__all__


def test_an_error_is_imported_without_the_devices() -> None:
    code = "import sys; from cell import RefusedError; assert 'cell.run.session.supervisor' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_unknown_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="nothing"):
        cell.nothing  # noqa: B018


def given(statement: ast.stmt) -> set[str]:
    """The names that a statement at the top gives; alternatives in an `if` or a `try`, and overloads, are none."""
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        overload = any(ast.unparse(mark).endswith("overload") for mark in statement.decorator_list)
        return set() if overload else {statement.name}
    if isinstance(statement, ast.Assign):
        targets = statement.targets
    else:
        targets = [statement.target] if isinstance(statement, ast.AnnAssign) else []
    # Values kept in an attribute or in a table are not names.
    names = (part for target in targets for part in ast.walk(target) if isinstance(part, ast.Name))
    return {name.id for name in names if isinstance(name.ctx, ast.Store)}


def test_no_module_gives_a_top_level_name_twice() -> None:
    """The later one would silently hold for both."""
    files = [file for room in ROOMS for file in sorted((ROOT / room).rglob("*.py"))]
    assert len(files) > 300
    twice = []
    for file in files:
        names = Counter(name for top in ast.parse(file.read_text(encoding="utf-8")).body for name in given(top))
        twice += [f"{file.relative_to(ROOT)}: {name}" for name, count in names.items() if count > 1 and name != "_"]
    assert twice == []
