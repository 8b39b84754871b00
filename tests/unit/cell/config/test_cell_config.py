"""Configuration and jobs: every quantity has its unit, every value its range, every mistake its own clear line."""

from __future__ import annotations

import re
import tomllib
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.base import units
from cell.base.units import parse_quantity
from cell.check.fit import require_fit
from cell.config.cell_config import CellConfig, default_toml, load_config, validate
from cell.config.job import job_path, load_job, shipped_jobs
from drivers.errors import ConfigError


def edited(**changes: Any) -> dict[str, Any]:
    """The shipped configuration with "table__key" set to another value, or removed with None."""
    data = tomllib.loads(default_toml())
    for path, value in changes.items():
        *tables, key = path.split("__")
        table = data
        for name in tables:
            table = table[name]
        if value is None:
            del table[key]
        else:
            table[key] = value
    return data


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [
        ("35 mm", "mm", 0.035),
        ("5deg", "deg", np.deg2rad(5)),
        ("500 kbit/s", "kbit/s", 500_000.0),
        ("+0.1m", "mm", 0.1),
        ("-10 mm", "mm", -0.01),
        ("2 ms", "ms", 0.002),
        ("1e-3 m", "mm", 0.001),
        ("200 mm/s^2", "mm/s^2", 0.2),
    ],
)
def test_a_quantity_is_read_into_si(text: str, unit: str, expected: float) -> None:
    assert parse_quantity(text, unit) == pytest.approx(expected, rel=1e-12)


def test_the_usual_units_are_those_of_the_library_to_the_last_bit() -> None:
    for unit, number in product(units._USUAL, ("35", "0.1", "-7.3e-3", "+123456.789", ".6", "1e3")):
        text = f"{number} {unit}"
        assert parse_quantity(text, unit) == units._converted(text, unit)[1], text


@pytest.mark.parametrize(
    "text", [35, 35.0, True, "35", "35 kg", "mm", "", "5 mm; 3", "nan mm", "-1e999 mm", "inf mm", "5 furlongs/", None]
)
def test_anything_but_a_number_with_a_fitting_unit_is_refused(text: object) -> None:
    for limits in ((0, 100), ()):
        with pytest.raises(ValueError, match=r"unit|quantity|range"):
            parse_quantity(text, "mm", *limits)


def test_a_value_out_of_range_is_named_with_its_range() -> None:
    with pytest.raises(ValueError, match=r'"120 mm" is outside the allowed range \(allowed: 0 to 100 mm\)'):
        parse_quantity("120 mm", "mm", 0, 100)


def test_the_shipped_configuration_is_valid() -> None:
    config = load_config(None)
    assert config.rail.lead == pytest.approx(0.002)
    assert config.laser.baseline == pytest.approx(0.035)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rail__laed": "2 mm"}, ["rail.laed", "unknown key"]),
        ({"rail__lead": 2}, ["rail.lead", "has no unit"]),
        ({"rail__lead": "2000 mm"}, ["rail.lead", "0.1 to 50 mm"]),
        ({"rail__lead": "50.1 mm"}, ["rail.lead", "0.1 to 50 mm"]),
        ({"rail__lead": "0.09 mm"}, ["rail.lead", "0.1 to 50 mm"]),
        ({"rail__lead": None}, ["rail.lead", "missing"]),
        ({"rail__travel": ["100 mm", "0 mm"]}, ["rail", "the first must be smaller"]),
        ({"rail__microsteps": 3}, ["rail.microsteps"]),
        ({"arm__max_joint_speed": "0 deg/s"}, ["arm.max_joint_speed", "1 to 120 deg/s"]),
        ({"claw__output": 0}, ["laser.output and claw.output are both", "arm output 0"]),
        ({"calibration__fine__board": "marked_dots:11"}, ["calibration.fine.board"]),
        ({"vehicle__driver": "tank"}, ["vehicle.driver", '"tank"', '"agilex"']),
    ],
)
def test_a_wrong_configuration_is_refused_by_key_and_value(changes: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        validate(CellConfig, edited(**changes), "cell.toml")
    for word in words:
        assert word in str(caught.value)


def test_all_mistakes_are_told_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        validate(CellConfig, edited(rail__lead=2, vehicle__track="3 kg", cell__colour="red"), "cell.toml")
    assert len(str(caught.value).splitlines()) == 4


def test_addresses_do_not_make_a_calibration_foreign_but_optics_do() -> None:
    own = load_config(None).calibration_hash()
    moved = validate(CellConfig, edited(scan_camera__address="10.0.0.1:1", rail__url="/dev/ttyUSB9"), "cell.toml")
    other = validate(CellConfig, edited(scan_camera__focal_length="8.1 mm"), "cell.toml")
    assert moved.calibration_hash() == own
    assert other.calibration_hash() != own


@pytest.mark.parametrize("name", shipped_jobs())
def test_every_shipped_job_is_valid(name: str) -> None:
    job, mesh = load_job(name)
    assert job.job.name == name
    assert mesh.is_file()


def test_a_job_that_does_not_exist_lists_those_that_do() -> None:
    with pytest.raises(ConfigError, match="pot"):
        load_job("teapot")


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


def test_a_missing_mesh_is_named(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(job_path("pot").read_text().replace("pot.ply", "gone.ply"))
    with pytest.raises(ConfigError, match=r"gone\.ply"):
        load_job(path)
