"""The dry run of a console: how far it is, and that it ends with who asked for it."""

import subprocess
import sys

import pytest

from cell.apps.console.host.rehearsal import Rehearsals
from cell.run.session.supervisor import Cell
from drivers.errors import InterlockError
from tests.support import running, until


def test_a_dry_run_tells_how_far_it_is_and_can_be_cancelled(cell: Cell):
    rehearsals = Rehearsals(cell)
    with pytest.raises(InterlockError):
        rehearsals.cancel()
    rehearsals.begin("pot", 3)
    assert until(lambda: (rehearsals.present or {}).get("text") == "simulating the cell", 60.0)
    process = rehearsals._process
    rehearsals.cancel()
    assert until(lambda: rehearsals.present is not None and rehearsals.present["state"] == "done")
    assert rehearsals.present["outcome"] == "cancelled"
    assert not running(process.pid)


def test_a_dry_run_ends_with_its_input(tmp_path):
    """The console holds the other end, which closes with it."""
    command = [sys.executable, "-m", "cell.apps.console.host.rehearsal", "pot", "3", "nominal", ""]
    process = subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdin is not None
    assert b"loading" in process.stdout.readline()
    process.stdin.close()
    assert process.wait(20.0) == 1
    process.stdout.close()
