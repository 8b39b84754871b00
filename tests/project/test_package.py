"""What a script can take from `cell` itself, and what the command line says of itself."""

from __future__ import annotations

import subprocess
import sys

import pytest

import cell
from drivers import errors


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
