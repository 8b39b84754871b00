"""Promises of a machine where numba does not load."""

from __future__ import annotations

import subprocess
import sys

WITHOUT_NUMBA = """
import sys, warnings

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "numba":
            raise ImportError("numba is missing")

sys.meta_path.insert(0, Missing())
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import cell.supervisor
    from cell.vision import extract
    from cell.bench.stripe_truth import Cell, draw

image, centres = draw(Cell(2, 100), (64, 320), 1)
error = abs(extract(image).centres - centres).max()
told = [str(w.message) for w in caught if issubclass(w.category, RuntimeWarning) and "numba" in str(w.message)]
print(len(told), told[0].count("Reinstall numba"), error < 0.2)
"""


def test_without_numba_the_cell_says_so_once_and_still_finds_stripes() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_NUMBA], capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["1", "1", "True"], done.stderr
