"""A job that asks for more than the cell can do is refused before anything moves."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cell.check.fit import require_fit
from cell.config.cell_config import CellConfig, load_config
from cell.config.job import Job, job_path, load_job
from drivers.errors import ConfigError


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (('length = "64 mm"', 'length = "99.5 mm"'), "scan.length 99.5 mm"),
        (('speed = "15 mm/s"', 'speed = "45 mm/s"'), "scan.speed 45 mm/s exceeds rail.max_speed, 40 mm/s"),
        (('speed = "0.4 m/s"', 'speed = "0.9 m/s"'), "approach.speed 900 mm/s exceeds vehicle.max_speed, 500 mm/s"),
    ],
)
def test_a_job_that_asks_too_much_of_the_cell_is_refused(tmp_path: Path, edit: tuple[str, str], words: str) -> None:
    source = job_path("pot")
    path = tmp_path / "mine.toml"
    path.write_text(source.read_text().replace(*edit).replace("pot.ply", str(source.parent / "pot.ply")))
    job, mesh = load_job(path)
    with pytest.raises(ConfigError, match=re.escape(words)):
        require_fit(job, load_config(None), mesh)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('-2750 mm", "0 mm"', '-750 mm", "0 mm"', "from stop left to stop right: .* within .* of the table at x"),
        ('-2750 mm", "0 mm"', '-2300 mm", "0 mm"', "right: at approach.staging the vehicle is still .* beside"),
        ('-2750 mm", "0 mm"', '-2750 mm", "50 mm"', "from stop left to stop right the floor rises by"),
        ("0.4 m/s", "0.025 m/s", r"from stop left to stop right takes \d+ s \(allowed: at most 150 s\)"),
    ],
)
def test_a_way_between_two_stops_that_the_vehicle_cannot_go_is_refused(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    source = job_path("two-stations")
    text = source.read_text()
    for mesh in ("facets.ply", "shell-part.ply"):
        text = text.replace(f'"{mesh}"', f'"{source.parent / mesh}"')
    (path := tmp_path / "mine.toml").write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=words):
        require_fit(*fitting(f"{path}#2"))
    require_fit(*fitting("two-stations#2"))


def fitting(name: str) -> tuple[Job, CellConfig, Path]:
    job, mesh = load_job(name)
    return job, load_config(None), mesh
