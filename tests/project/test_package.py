"""What a script can take from `cell` itself, and what the command line says of itself."""

import re
import subprocess
import sys
from collections import Counter

import pytest

import cell
from drivers import errors
from tests.support import ROOT

ROOMS = ("cell", "drivers", "statemachine", "sim_backends", "lab")


def test_every_error_of_the_tree_is_in_the_package():
    tree = [
        name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, errors.CellError)
    ]
    assert len(tree) > 10
    for name in tree:
        assert getattr(cell, name) is getattr(errors, name)
        assert name in cell.__all__


def test_an_error_is_imported_without_the_devices():
    code = "import sys; from cell import RefusedError; assert 'cell.run.session.supervisor' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_unknown_name_is_no_attribute():
    with pytest.raises(AttributeError, match="nothing"):
        cell.nothing  # noqa: B018


def test_no_module_gives_a_name_at_the_top_two_values():
    """The later one would silently hold for both; functions and classes are mypy's."""
    files = [file for room in ROOMS for file in sorted((ROOT / room).rglob("*.py"))]
    assert len(files) > 300
    twice = []
    for file in files:
        given = re.findall(r"^(\w+(?:, \w+)*)(?:: .+?)? = ", file.read_text(encoding="utf-8"), re.MULTILINE)
        names = Counter(name for names in given for name in names.split(", "))
        twice += [f"{file.relative_to(ROOT)}: {name}" for name, count in names.items() if count > 1 and name != "_"]
    assert twice == []
