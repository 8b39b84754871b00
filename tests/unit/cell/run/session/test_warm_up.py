"""What a first job needs is compiled beside its calibration, by a process that ends with its own."""

import os
import subprocess
import sys

import pytest


@pytest.mark.campaign
def test_what_a_first_job_compiles_was_compiled_ahead(tmp_path):
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


def test_who_compiles_ahead_ends_with_the_other(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-m", "cell.run.session.warm_up"], stdin=subprocess.PIPE, env=environment
    ) as ahead:
        ahead.stdin.close()
        assert ahead.wait(60) == 0
    assert len(list(tmp_path.rglob("*.nbi"))) < 40
