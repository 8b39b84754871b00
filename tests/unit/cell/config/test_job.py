"""Promises of `cell.config.job`."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.base.storage import write_json
from cell.base.toml_file import restored
from cell.config.job import Job, job_path, load_job, shipped_jobs
from drivers.errors import ConfigError


@pytest.mark.parametrize("name", shipped_jobs())
def test_every_shipped_job_is_valid(name: str) -> None:
    job, mesh = load_job(name)
    assert job.job.name == name
    assert mesh.is_file()


def test_a_missing_mesh_is_named(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(job_path("pot").read_text().replace("pot.ply", "gone.ply"))
    with pytest.raises(ConfigError, match=r"gone\.ply"):
        load_job(path)


def test_the_job_of_the_present_folder_wins_over_the_one_that_ships(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = job_path("pot")
    assert shipped.is_absolute()
    Path("pot").mkdir()
    assert job_path("pot") == shipped
    Path("pot.toml").write_text(shipped.read_text())
    assert job_path("pot") == Path("pot.toml")
    assert job_path(shipped) == shipped


def test_a_job_that_says_nothing_of_batches_is_written_as_before(tmp_path: Path) -> None:
    shipped, text = job_path("pot"), job_path("pot").read_text()
    assert "batch" not in load_job("pot")[0].model_dump(mode="json")
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("pot.ply", str(shipped.with_suffix(".ply"))) + '[batch]\non_refusal = "skip"\n')
    job = load_job(path)[0]
    write_json(tmp_path / "job.json", job.model_dump(mode="json"))
    assert restored(Job, tmp_path / "job.json") == job
    path.write_text(path.read_text().replace("skip", "later"))
    with pytest.raises(ConfigError, match=r'batch\.on_refusal.*"end", "ask" or "skip"'):
        load_job(path)
