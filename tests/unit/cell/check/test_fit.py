"""A job that asks for more than the cell can do is refused before anything moves."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cell.check.fit import require_fit
from cell.config.cell_config import load_config
from cell.config.job import job_path, load_job
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
