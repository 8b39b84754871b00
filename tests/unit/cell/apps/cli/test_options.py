"""What a shell offers at tab, asked as bash asks it."""

import subprocess
import sys
from pathlib import Path

import pytest

from cell.apps.cli import options as completing
from cell.config.cell_config import DEVICES
from cell.config.job import shipped_jobs
from sim_backends.world.levels import Effects
from tests.support import ROOT

ASK = """
source <(cell --show-completion bash)
offered() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=(); _cell_completion cell; echo "${COMPREPLY[*]}"; }
offered cell report ""
offered cell dry-run --inject arm.p"""


@pytest.mark.skipif(not Path("/bin/bash").exists(), reason="there is no bash here")
def test_bash_offers_runs_and_faults(tmp_path):
    for name in ("20260101T000000-00aa", "20260102T000000-00bb"):
        (tmp_path / "elsewhere" / name).mkdir(parents=True)
        (tmp_path / "elsewhere" / name / "journal.sqlite").write_text("")
    (tmp_path / "elsewhere" / "notes").mkdir()
    (tmp_path / "cell.toml").write_text('[cell]\nruns = "elsewhere"\n')
    command = tmp_path / "bin" / "cell"
    command.parent.mkdir()
    command.write_text(f"#!{sys.executable}\nfrom cell.apps.cli import main\nmain()\n")
    command.chmod(0o755)
    environment = {"PATH": f"{command.parent}:/usr/bin:/bin", "PYTHONPATH": str(ROOT)}
    told = subprocess.run(
        ["/bin/bash", "--norc", "-c", ASK], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
    )
    assert told.stdout.splitlines() == ["00bb 00aa", "arm.protective_stop"], told.stderr


def test_names_are_offered_and_nothing_where_something_is_wrong(here: Path):
    (here / "mine.toml").write_text("[job]\n")
    (here / "cell.toml").write_text("[cell]\n")
    (here / "broken.toml").write_text("[job\n")
    assert completing.jobs("") == sorted([*shipped_jobs(), "mine"])
    assert completing.jobs("p") == [name for name in shipped_jobs() if name.startswith("p")]
    assert (completing.devices(""), completing.effects("rolling")) == (list(DEVICES), ["rolling_shutter"])
    assert (set(completing.effects("")), completing.steps("laser")) == (set(Effects.names()), ["laser_sweep"])
    assert completing.among("rail", "arm", "vehicle")("v") == ["vehicle"]
    context = type("Context", (), {"params": {"config": Path("broken.toml")}})()
    assert completing.runs(context, "") == []
