"""Promises of `cell.config.job`."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.config.job import job_path, load_job, shipped_jobs
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


@pytest.mark.usefixtures("here")
def test_the_job_of_the_present_folder_wins_over_the_one_that_ships() -> None:
    shipped = job_path("pot")
    assert shipped.is_absolute()
    Path("pot").mkdir()
    assert job_path("pot") == shipped
    Path("pot.toml").write_text(shipped.read_text())
    assert job_path("pot") == Path("pot.toml")
    assert job_path(shipped) == shipped


def test_what_a_batch_does_is_checked_and_no_part_of_what_runs_rest_on(tmp_path: Path) -> None:
    shipped, path = job_path("pot"), tmp_path / "mine.toml"
    text = shipped.read_text().replace('"pot.ply"', f'"{shipped.with_suffix(".ply")}"')
    path.write_text(f'{text}\n[batch]\non_refusal = "skip"\n')
    job = load_job(path)[0]
    assert (job.batch.on_refusal, load_job("pot")[0].batch.on_refusal) == ("skip", "end")
    assert "batch" not in job.model_dump(mode="json")
    path.write_text(path.read_text().replace("skip", "later"))
    with pytest.raises(ConfigError, match=r'batch\.on_refusal.*"end", "ask" or "skip"'):
        load_job(path)
