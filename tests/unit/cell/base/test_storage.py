"""Files that must survive are there whole, or as they were; a run whose output nobody reads says so."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from cell.apps.cli import LEAST_MEMORY_B
from cell.base.storage import read_json, replacing, sealed, write_json
from drivers.errors import CellError

FULL = """
import resource, signal, sys
from pathlib import Path
from cell.base.storage import write_json
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
try:
    write_json(Path(sys.argv[1]), {"long": "x" * 10_000})
except OSError as error:
    print(error.errno)"""


def test_a_disk_that_takes_no_more_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "kept.json"
    write_json(path, {"short": 1})
    done = subprocess.run([sys.executable, "-c", FULL, str(path)], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip().isdigit(), done.stderr
    with pytest.raises(CellError, match="is not written"):
        write_json(path, {"value": float("nan")})
    with pytest.raises(ZeroDivisionError), replacing(path) as file:
        file.write(bytes(1 // len(b"")))
    assert [read_json(path).content, list(tmp_path.iterdir())] == [{"short": 1}, [path]]


def test_a_file_and_its_name_are_on_the_disk_before_it_counts_as_written(tmp_path, monkeypatch):
    done: list[str] = []
    sync, rename = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (done.append(str(Path(f"/proc/self/fd/{fd}").readlink())), sync(fd))[1])
    monkeypatch.setattr(Path, "replace", lambda self, to: (done.append("renamed"), rename(self, to))[1])
    write_json(tmp_path / "kept.json", sealed({"run": "a", "value": (1, 2)}))
    assert [done[0].endswith(".tmp"), *done[1:]] == [True, "renamed", str(tmp_path)]


def test_a_digest_is_of_what_is_said_and_not_of_the_names_and_dates_of_a_run():
    one, other = (sealed({"run": run, "faults": [{"at": run, "code": "x"}]})["sha256"] for run in "ab")
    assert one == other != sealed({"run": "a", "faults": [{"at": "a", "code": "y"}]})["sha256"]


def cell(*arguments: str, folder: Path, **limits: int) -> subprocess.CompletedProcess[str]:
    line = f'exec {sys.executable} -c "from cell.apps.cli import main; main()" {" ".join(arguments)}'

    def limit() -> None:
        for name, value in limits.items():
            resource.setrlimit(getattr(resource, name), (value, value))

    return subprocess.run(
        ["bash", "-c", line], cwd=folder, capture_output=True, text=True, timeout=300, preexec_fn=limit
    )


def test_too_little_memory_is_said_before_anything_begins(tmp_path):
    done = cell("dry-run", folder=tmp_path, RLIMIT_AS=LEAST_MEMORY_B // 2)
    assert (done.returncode, "`cell dry-run` needs 3 GB" in done.stderr) == (2, True)
    assert cell("runs", folder=tmp_path, RLIMIT_AS=LEAST_MEMORY_B // 2).returncode == 0


def test_a_closed_output_is_said_and_no_file_takes_its_place(tmp_path):
    done = cell("runs", ">&-", folder=tmp_path)
    assert (done.returncode, "standard output is closed" in done.stderr) == (0, True)


RUN = """
import sys
from contextlib import nullcontext
from pathlib import Path
from cell.apps.cli.commands.run import _perform
from cell.run.job_run import RunOutcome
_perform(lambda: nullcontext(), lambda cell, display: RunOutcome("placed", "", Path("r1"), {"x": 1}), True, False)"""


def test_a_run_whose_output_nobody_reads_says_how_it_ended():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([sys.executable, "-c", RUN], stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert "run r1 ended placed, but that cannot be shown: [Errno 28]" in done.stderr
