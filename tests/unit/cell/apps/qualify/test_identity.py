"""What a row is of: every hash changes with what it stands for, and with nothing else."""

from pathlib import Path

import pytest

from cell.apps.qualify.identity import QualifiedCode, code_hash, configuration_hash, require_seeds
from cell.config.cell_config import default_toml, load_config
from cell.config.job import job_path
from drivers.errors import ConfigError
from tests.support.qualified import OF


def test_a_configuration_is_what_it_says(tmp_path):
    plain = configuration_hash(load_config(None))
    file = tmp_path / "cell.toml"
    file.write_text("# mine\n" + default_toml(), encoding="utf-8")
    assert configuration_hash(load_config(file)) == plain
    config = load_config(None)
    elsewhere = config.model_copy(update={"cell": config.cell.model_copy(update={"runs": "other", "record": False})})
    assert configuration_hash(elsewhere) == plain, "where files go changes no world"
    slower = config.model_copy(update={"arm": config.arm.model_copy(update={"repeatability": 1e-4})})
    assert configuration_hash(slower) != plain


def test_a_job_is_its_file_and_its_meshes(here: Path):
    config, shipped = load_config(None), job_path("pot")
    before = QualifiedCode.of("pot", config)
    assert before.code_hash == code_hash()
    text = shipped.read_text(encoding="utf-8")
    (here / "pot.ply").write_bytes((shipped.parent / "pot.ply").read_bytes())
    (here / "pot.toml").write_text(text, encoding="utf-8")
    assert QualifiedCode.of("pot", config) == before
    (here / "pot.toml").write_text(text + "\n# another\n", encoding="utf-8")
    assert QualifiedCode.of("pot", config).job_hash != before.job_hash
    assert QualifiedCode.of("tray4#2", config).job == "tray4#2"


def test_each_world_has_a_key_of_its_own():
    keys = {OF.key(level, seed, how) for level in ("nominal", "harsh") for seed in (1, 2) for how in ("", "faults")}
    assert len(keys) == 8
    assert OF.key("nominal", 1) == OF.key("nominal", 1)


@pytest.mark.parametrize(("first", "count"), [(1, 0), (-1, 5), (999_999, 2)])
def test_seeds_that_are_none_are_refused(first: int, count: int):
    with pytest.raises(ConfigError, match="allowed"):
        require_seeds(first, count)
