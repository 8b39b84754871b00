"""Promises of the compiled loops: of a machine where numba does not load, and of when the others are loaded."""

import subprocess
import sys

import pytest

from tests.support import ROOT

WITHOUT_NUMBA = """
import sys, warnings

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "numba":
            raise ImportError("numba is missing")

sys.meta_path.insert(0, Missing())
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import cell.run.session.supervisor
    from cell.base.compiled import load
    from cell.measure.vision.stripe.extract import extract
    from lab.bench.stripe.truth import Cell, draw
    load()

image, centres = draw(Cell(2, 100), (64, 320), 1)
error = abs(extract(image).centres - centres).max()
told = [str(w.message) for w in caught if issubclass(w.category, RuntimeWarning) and "numba" in str(w.message)]
print(len(told), told[0].count("Reinstall numba"), error < 0.2)
"""


def test_without_numba_the_cell_says_so_once_and_still_finds_stripes():
    done = subprocess.run([sys.executable, "-c", WITHOUT_NUMBA], capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["1", "1", "True"], done.stderr


LOADED = """
import sys
from cell import Cell
early = "numba" in sys.modules
import importlib, pkgutil
from cell.measure.vision import stripe
from lab.bench.stripe.truth import Cell, draw
from cell.procedures.sweep.swath import warm_up
from cell.measure.vision.stripe.extract import StripeStream
from tests.unit.cell.measure.reconstruction.test_build import GEOMETRY

def loaded():
    found = pkgutil.walk_packages(stripe.__path__, f"{stripe.__name__}.")
    modules = [importlib.import_module(m.name) for m in found]
    return {name: len(f.signatures) for m in modules for name, f in vars(m).items() if hasattr(f, "signatures")}

before = loaded()
warm_up(GEOMETRY)
rehearsed = loaded()
shape = (GEOMETRY.camera.height, GEOMETRY.camera.width)
stream = StripeStream()
for seed, speckle in enumerate([0.0, 0.2, 0.2]):
    stream.extract(draw(Cell(2.0, 100.0, speckle), shape, seed)[0])
print(early, sum(before.values()) < sum(rehearsed.values()), loaded() == rehearsed)
"""


@pytest.fixture(scope="module")
def loaded() -> list[str]:
    """Of a process of its own: numba with `Cell` already, loops while a sweep is rehearsed, none after that."""
    done = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_the_door_itself_does_not_wait_for_numba(loaded: list[str]):
    assert loaded[0] == "False"


def test_nothing_is_loaded_or_compiled_any_more_when_a_sweep_has_begun(loaded: list[str]):
    assert loaded[1:] == ["True", "True"]
