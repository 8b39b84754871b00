"""Promises of the compiled loops: of a machine where numba does not load, and of when the others are loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
    from cell.measure.vision import extract
    from lab.bench.stripe.truth import Cell, draw

image, centres = draw(Cell(2, 100), (64, 320), 1)
error = abs(extract(image).centres - centres).max()
told = [str(w.message) for w in caught if issubclass(w.category, RuntimeWarning) and "numba" in str(w.message)]
print(len(told), told[0].count("Reinstall numba"), error < 0.2)
"""


def test_without_numba_the_cell_says_so_once_and_still_finds_stripes() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_NUMBA], capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["1", "1", "True"], done.stderr


REHEARSED = """
import importlib, pkgutil
from cell.measure.vision import stripe
from lab.bench.stripe.truth import Cell, draw
from cell.procedures.sweep.swath import rehearse
from cell.measure.vision import StripeStream
from tests.unit.cell.measure.reconstruction.test_build import GEOMETRY

def loaded():
    found = pkgutil.walk_packages(stripe.__path__, f"{stripe.__name__}.")
    modules = [importlib.import_module(m.name) for m in found]
    return {name: len(f.signatures) for m in modules for name, f in vars(m).items() if hasattr(f, "signatures")}

before = loaded()
rehearse(GEOMETRY)
rehearsed = loaded()
shape = (GEOMETRY.camera.height, GEOMETRY.camera.width)
stream = StripeStream()
for seed, speckle in enumerate([0.0, 0.2, 0.2]):
    stream.extract(draw(Cell(2.0, 100.0, speckle), shape, seed)[0])
print(sum(before.values()) < sum(rehearsed.values()), loaded() == rehearsed)
"""


def test_nothing_is_loaded_or_compiled_any_more_when_a_sweep_has_begun() -> None:
    done = subprocess.run([sys.executable, "-c", REHEARSED], capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert done.stdout.split() == ["True", "True"], done.stdout + done.stderr


@pytest.mark.campaign
def test_what_a_first_job_compiles_was_compiled_ahead(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}

    def ours() -> set[str]:
        return {path.name for path in (tmp_path / "kept").rglob("*.nbi") if "optics" not in path.parent.name}

    with subprocess.Popen(
        [sys.executable, "-m", "cell.run.session.warm_up"], stdin=subprocess.PIPE, env=environment
    ) as ahead:
        assert ahead.wait(200) == 0
    before = ours()
    command = [sys.executable, "-c", "from cell.apps.cli import main; main()", "dry-run", "--clock", "virtual"]
    subprocess.run(command, check=True, cwd=tmp_path, capture_output=True, timeout=300, env=environment)
    assert len(before) > 40
    # Only a line that is hard to follow needs this one.
    assert {name.partition("-")[0] for name in ours() - before} <= {"follow._chain"}


def test_who_compiles_ahead_ends_with_the_other(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-m", "cell.run.session.warm_up"], stdin=subprocess.PIPE, env=environment
    ) as ahead:
        assert ahead.stdin is not None
        ahead.stdin.close()
        assert ahead.wait(60) == 0
    assert len(list(tmp_path.rglob("*.nbi"))) < 40
