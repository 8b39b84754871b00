"""Which configuration a command works with: the named one, else the present folder's; nothing moves at another."""

import json
from pathlib import Path

import pytest

from cell import Cell, ConfigError
from cell.config.cell_config import (
    config_to_open,
    default_toml,
    find_config,
    load_config,
    require_confirm,
    require_real_addresses,
    runs_folder,
)
from cell.devices.simulated.process import with_endpoints
from tests.support import Typed

pytestmark = pytest.mark.usefixtures("here")

MOVING = (["run"], ["home"], ["jog", "rail", "+5mm"], ["calibrate"], ["calibrate", "verify"], ["diag"])
ENDPOINTS = {
    "speed": 3.0, "truth": {"address": "127.0.0.1:4001"}, "arm": {"address": "127.0.0.2"},
    "rail": {"url": "socket://127.0.0.1:4002"}, "vehicle": {"interface": "slcan", "channel": "socket://127.0.0.1:4003"},
    "scan_camera": {"address": "127.0.0.1:4004"}, "target_camera": {"address": "127.0.0.1:4005"},
}  # fmt: skip


@pytest.mark.parametrize("words", MOVING, ids=" ".join)
def test_nothing_moves_without_a_configuration_of_the_present_folder_or_at_the_examples_addresses(
    typed: Typed, words: list[str]
):
    code, _, error = typed(*words)
    assert code == 2 and "there is no cell.toml" in error and "192.0.2" not in error
    Path("mine.toml").write_text(default_toml())
    code, _, error = typed(*words, "-c", "mine.toml")
    assert code == 2 and "still the example's" in error
    Path("cell.toml").write_text(default_toml().replace("192.0.2.10", "192.0.2.77"))
    code, _, error = typed(*words)
    assert code == 2 and 'arm.address = "192.0.2.77"' in error


def test_what_is_named_wins_and_a_simulated_cell_needs_no_file():
    assert find_config(None, simulated=True) is None
    with pytest.raises(ConfigError):
        find_config(None)
    Path("cell.toml").write_text(default_toml())
    assert find_config(None) == find_config(None, simulated=True) == Path("cell.toml")
    assert find_config(Path("other.toml")) == Path("other.toml")


def test_a_broken_local_file_is_no_reason_to_take_another(typed: Typed):
    Path("cell.toml").symlink_to("gone.toml")
    for words in (["check"], ["runs"], ["dry-run"], *MOVING):
        code, _, shown = typed(*words)
        assert code == 2 and "cell.toml does not exist" in shown


def test_check_reads_the_local_files_and_says_which(typed: Typed):
    assert json.loads(typed("check", "--json")[1])["configuration"] == "the one that ships"
    assert typed("init")[0] == 0
    told = json.loads(typed("check", "--json")[1])
    assert (told["ok"], told["configuration"], told["job_file"]) == (True, "cell.toml", "pot.toml")
    assert (told["job"], told["mesh"]) == ("pot", "pot.ply")
    assert any("192.0.2.10" in note for note in told["notes"])
    Path("cell.toml").write_text(default_toml().replace('lead = "2 mm"', 'lead = "2"'))
    assert typed("check")[0] == 2


def test_runs_are_looked_for_where_the_local_file_says(typed: Typed):
    Path("cell.toml").write_text(default_toml().replace('runs = "runs"', 'runs = "mine"'))
    code, _, shown = typed("report")
    assert code == 2 and str(Path.cwd() / "mine") in shown


def test_only_a_simulated_cell_may_confirm_by_itself():
    real = load_config(None)
    assert real.cell.confirm == "person"
    require_confirm(real)
    _, wished = config_to_open(None, simulated=True, confirm="simulated")
    with pytest.raises(ConfigError, match="only for a simulated cell"):
        require_confirm(wished)
    for config, confirm in ((real, "person"), (wished, "simulated")):
        simulated = with_endpoints(config, ENDPOINTS)
        assert simulated.cell.confirm == confirm
        require_confirm(simulated)
        require_real_addresses(simulated)


def test_a_real_cell_that_is_to_confirm_by_itself_is_not_opened(tmp_path):
    path, text = tmp_path / "cell.toml", default_toml().replace("192.0.2", "127.0.0")
    path.write_text(text)
    with pytest.raises(ConfigError, match="a person looks and confirms"):
        Cell.open(path, confirm="simulated")
    path.write_text(text.replace('confirm = "person"', 'confirm = "simulated"'))
    with pytest.raises(ConfigError, match="a person looks and confirms"):
        Cell.open(path)


@pytest.mark.parametrize(
    ("text", "runs"),
    [
        ('[cell]\nname = "a"\nruns = "mine"\n[rail]\nlead = 2\n', "mine"),
        ('[cell]\nruns = "../outside"\n', "runs"),
        ("[cell]\nruns = 7\n", "runs"),
        ("cell = 3\n", "runs"),
        ("no toml at all", "runs"),
    ],
)
def test_what_goes_on_is_found_however_wrong_the_configuration_has_become(tmp_path, text: str, runs: str):
    (tmp_path / "cell.toml").write_text(text)
    assert runs_folder(tmp_path / "cell.toml") == tmp_path / runs
