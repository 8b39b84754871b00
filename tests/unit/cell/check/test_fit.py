"""A job that asks for more than the cell can do is refused before anything moves."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cell.check.fit import require_fit
from cell.config.cell_config import load_config
from cell.config.job import load_job
from drivers.errors import ConfigError
from tests.unit.cell.config.test_job import changed_copy


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (('length = "64 mm"', 'length = "99.5 mm"'), "scan.length 99.5 mm"),
        (('speed = "15 mm/s"', 'speed = "45 mm/s"'), "scan.speed 45 mm/s exceeds rail.max_speed, 40 mm/s"),
        (('speed = "0.4 m/s"', 'speed = "0.9 m/s"'), "approach.speed 900 mm/s exceeds vehicle.max_speed, 500 mm/s"),
    ],
)
def test_a_job_that_asks_too_much_of_the_cell_is_refused(tmp_path: Path, edit: tuple[str, str], words: str) -> None:
    job, mesh = load_job(changed_copy("pot", tmp_path, *edit))
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
    job, mesh = load_job(f"{changed_copy('two-stations', tmp_path, old, new)}#2")
    with pytest.raises(ConfigError, match=words):
        require_fit(job, load_config(None), mesh)


def test_the_way_between_the_stops_that_ship_can_be_gone() -> None:
    job, mesh = load_job("two-stations#2")
    require_fit(job, load_config(None), mesh)
