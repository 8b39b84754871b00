"""`cell init` and `cell check`: what is written is complete and right, and nothing is ever overwritten."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.apps.cli.app import app
from cell.config.job import shipped_jobs


@pytest.mark.parametrize("job", shipped_jobs())
def test_what_init_writes_passes_the_check_and_is_not_overwritten(here: Path, job: str):
    assert CliRunner().invoke(app, ["init", "own", "--job", job]).exit_code == 0
    written = {path.name: path.read_bytes() for path in (here / "own").iterdir()}
    assert {"cell.toml", f"{job}.toml"} < written.keys()
    done = CliRunner().invoke(app, ["check", "-c", "own/cell.toml", "-j", f"own/{job}.toml", "--json"])
    told = json.loads(done.stdout)
    assert (done.exit_code, told["ok"], told["problems"]) == (0, True, [])
    # The addresses that ship are no device's.
    assert any(note.startswith("arm.address") and "is the example's" in note for note in told["notes"])
    refused = CliRunner().invoke(app, ["init", "own", "--job", job])
    assert "exists already" in str(refused.exception)
    assert {path.name: path.read_bytes() for path in (here / "own").iterdir()} == written


def test_a_job_whose_files_init_cannot_keep_apart_is_refused_before_anything_is_written(here: Path):
    CliRunner().invoke(app, ["init", "own", "--job", "pot"])
    (here / "own" / "cell.toml").write_text((here / "own" / "pot.toml").read_text())
    refused = CliRunner().invoke(app, ["init", "other", "--job", "own/cell.toml"])
    assert "give the job another name" in str(refused.exception) and not (here / "other").exists()
