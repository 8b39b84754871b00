"""Planted bugs: each of `planted.toml` is one change to a copy of the product, and the tests that it names must fail.

Run with `pytest -m mutants -n 2 --dist load`. A change that no longer applies fails as well, and so do tests that fail
without any.
"""

import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLACES = ("cell", "drivers", "statemachine", "sim_backends", "lab", "tests", "pyproject.toml", "README.md", "docs")
TIMEOUT_S = 240.0

pytestmark = pytest.mark.mutants


@dataclass(frozen=True)
class Bug:
    """`old` becomes `new` in `file`, where it stands once; one of `tests` must fail."""

    area: str
    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.area}: {self.name}"


def planted() -> list[Bug]:
    rows = tomllib.loads((Path(__file__).parent / "planted.toml").read_text(encoding="utf-8"))["bug"]
    return [Bug(**{**row, "tests": tuple(row["tests"])}) for row in rows]


BUGS = planted()


@pytest.fixture(scope="session")
def copy(tmp_path_factory) -> Iterator[Path]:
    """A copy of the product and its tests; compiled kernels come along, because the times of the files are kept."""
    folder = tmp_path_factory.mktemp("planted")
    for name in PLACES:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name)
        else:
            shutil.copy2(source, folder / name)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def run(copy: Path, *tests: str) -> subprocess.CompletedProcess[str]:
    """The tests in the copy; nothing that is compiled there outlives it."""
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", "-n0", *tests],
        cwd=copy, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S,
        env={**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip


def named(test: str) -> str:
    return test.split("::")[0]


@pytest.mark.parametrize("file", sorted({named(test) for bug in BUGS for test in bug.tests}))
def test_without_a_planted_bug_the_tests_pass(copy: Path, file: str):
    tests = sorted({test for bug in BUGS for test in bug.tests if named(test) == file})
    done = run(copy, *tests)
    assert done.returncode == 0, done.stdout[-3000:]


@pytest.mark.parametrize("bug", BUGS, ids=str)
def test_a_planted_bug_is_noticed(copy: Path, bug: Bug):
    file = copy / bug.file
    text = file.read_text(encoding="utf-8")
    assert text.count(bug.old) == 1, f"{bug.old!r} stands {text.count(bug.old)} times in {bug.file}; plant it anew"
    file.write_text(text.replace(bug.old, bug.new), encoding="utf-8")
    try:
        # What is wrong fails at once; tried again, a fixture that it has spoilt may be an error before that.
        done = run(copy, "-p", "no:rerunfailures", *bug.tests)
    finally:
        shutil.copy2(ROOT / bug.file, file)
    assert done.returncode != 0, f"nobody noticed: {bug}"
    assert done.returncode == 1, f"the tests did not run:\n{done.stdout[-3000:]}{done.stderr[-1000:]}"
    assert " failed" in done.stdout, done.stdout[-3000:]
