"""Jobs whose put-down makes no sense are refused with the value and what is allowed, before anything moves."""

import re
from functools import reduce
from operator import getitem
from typing import Any

import numpy as np
import pytest

from cell.base.toml_file import read_toml, validate
from cell.check.fit import require_fit
from cell.check.place import contact_notes, contact_problems, mating_problems, mesh_box, surface_problems, under_part
from cell.config.cell_config import load_config
from cell.config.job import Job, load_job, shipped_jobs
from drivers.errors import ConfigError
from lab.bench.job.part_jobs import job_with_part

MESH = load_job("pot")[1]
POT = MESH.with_suffix(".toml")


CONFIG = load_config(None)


def changed(key: str, value: Any) -> Job:
    raw = read_toml(POT, "job", "")
    *parents, last = key.split(".")
    reduce(getitem, parents, raw)[last] = value
    return validate(Job, raw, "job")


def test_the_drawing_of_the_part_is_held_against_that_of_the_surface(tmp_path):
    job, mesh = load_job(job_with_part(tmp_path, "pot"))
    assert list(mating_problems(job, mesh)) == []
    *_, boxed, face, looked = contact_notes(job, mesh)
    assert re.fullmatch(r"the part's mesh goes \d+\.\d mm beyond its box, grasp\.size: .*", boxed)
    assert face.startswith("the part's mating face, as drawn: gap 0.00 to 0.00 mm")
    assert looked.startswith("nobody looks how the part lies once it was placed")
    wrong, mesh = load_job(job_with_part(tmp_path, "pot", lambda corners: corners - np.array([0.0, 0.0, 0.4e-3])))
    (told,) = mating_problems(wrong, mesh)
    assert re.search(r'part\.mesh "pot-part\.ply": the part as drawn goes 0\.40 mm into the surface at', told)
    aside, mesh = load_job(job_with_part(tmp_path, "pot", lambda corners: corners + np.array([0.2, 0.0, 0.0])))
    (told,) = mating_problems(aside, mesh)
    assert "nothing of the surface, or the triangles of part.mesh face inwards" in told
    with pytest.raises(ConfigError, match=r"does not fit this cell:\n.*part\.mesh"):
        require_fit(wrong, CONFIG, mesh)


def test_without_a_mesh_of_the_part_it_is_told_what_is_not_looked_at():
    job, mesh = load_job("pot")
    assert list(mating_problems(job, mesh)) == []
    told = "whether its underside fits the surface, and how it lies once it was placed, is not looked at"
    assert told in list(contact_notes(job, mesh))[-1]


@pytest.mark.parametrize("name", shipped_jobs())
def test_the_jobs_that_ship_make_sense(name: str):
    job, mesh = load_job(name)
    assert list(contact_problems(job, CONFIG, mesh)) == []


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("place.contact_force", "119 N", r"119 N .*\(allowed: 2 to 102 N"),
        ("place.contact_speed", "40 mm/s", "goes on by 2 mm.* at most 12 mm/s"),
        ("place.contact_travel", "0.1 mm", "at least 0.3 mm"),
        ("place.tolerance", "0.01 mm", "cannot be kept: grasp.sigma .* leave 0.*mm open"),
        ("place.tolerance_angle", "0.1 mrad", "cannot be kept: grasp.sigma_angle"),
        ("grasp.sigma", "5 mm", "leave 5 mm open"),
        ("grasp.sigma_angle", "50 mrad", "leave 50 mrad open"),
        ("grasp.size", ["400 mm", "400 mm", "20 mm"], "1 % of the part's footprint"),
        ("grasp.size", ["70 mm", "36 mm", "1 mm"], "goes through the whole part, 8.38 mm"),
        ("scan.exposure", "30 ms", "smears a line by 0.45 mm"),
        ("place.surface_from_part.translation", ["0 mm", "0 mm", "10 mm"], "1.62 mm below .* in the air"),
        ("place.surface_from_part.translation", ["40 mm", "0 mm", "0 mm"], "43 % of the part's footprint"),
        ("place.surface_from_part.translation", ["300 mm", "0 mm", "0 mm"], "0 % of the part's footprint"),
    ],
)
def test_a_senseless_put_down_is_refused_with_its_number(key: str, value: Any, told: str):
    problems = list(contact_problems(changed(key, value), CONFIG, MESH))
    assert any(re.search(told, problem) for problem in problems), problems


def test_a_part_whose_lowest_plane_ends_over_the_surface_comes_down_onto_it():
    """The surface lies 0.1 mm below that plane, within `place.contact_travel`."""
    higher = changed("place.surface_from_part.translation", ["0 mm", "0 mm", "8.49 mm"])
    assert under_part(higher, MESH)[1] == pytest.approx(-0.1e-3, abs=0.02e-3)
    assert list(contact_problems(higher, CONFIG, MESH)) == []


def test_how_deep_the_surface_reaches_into_the_part_is_noted():
    deeper = changed("place.surface_from_part.translation", ["0 mm", "0 mm", "-5 mm"])
    assert "13.4 mm into the part's box of 20 mm" in next(contact_notes(deeper, MESH))


@pytest.mark.parametrize(("turn", "wrong"), [("0 deg", False), ("180 deg", True)])
def test_a_surface_that_faces_away_from_the_part_is_refused(turn: str, wrong: bool):
    job = changed("place.surface_from_part.rotation", [turn, "0 deg", "0 deg"])
    assert any("face away" in text for text in surface_problems(job, mesh_box(MESH, "m"), MESH)) == wrong


def test_an_area_beside_the_surface_is_refused():
    job = changed("surface.area", [{"name": "far", "centre": ["900 mm", "0 mm"], "size": ["10 mm", "10 mm"]}])
    assert any('surface.area "far" lies beside' in text for text in surface_problems(job, mesh_box(MESH, "m"), MESH))
