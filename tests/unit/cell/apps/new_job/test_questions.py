"""Promises of `cell.apps.new_job.questions`."""

import numpy as np
import pytest
import trimesh

from cell.apps.new_job.mesh_file import read_drawing
from cell.apps.new_job.questions import Asker, checked, laid_mesh, told_by_size
from cell.apps.new_job.surface import open_side
from cell.config.job import SurfaceSection
from drivers.errors import ConfigError


@pytest.mark.parametrize(("longest", "unit"), [(60.0, "mm"), (0.14, "m"), (5.0, "inch")])
def test_a_unit_is_told_by_the_size_where_one_alone_makes_sense(longest: float, unit: str):
    found, words = told_by_size(longest)
    assert found == unit and f"taken as {unit}" in words


@pytest.mark.parametrize("longest", [16.0, 600.0, 0.001])
def test_a_unit_that_the_size_does_not_tell_is_asked_for(longest: float):
    with pytest.raises(ConfigError, match="--unit"):
        told_by_size(longest)


def test_a_wrong_answer_is_told_and_asked_again():
    answers = iter(["3", "200 mm", "0.5 mm"])
    told: list[str] = []
    asker = Asker({}, lambda question, default: next(answers), told.append)
    assert asker.get("prior", "How exactly", "3 mm", checked(SurfaceSection, "prior_sigma")) == 0.0005
    assert "no unit" in told[0] and "0.01 to 100 mm" in told[0] and "0.01 to 100 mm" in told[1]
    with pytest.raises(ConfigError, match=r"--prior: .*0\.01 to 100 mm"):
        Asker({"prior": "200 mm"}, None, told.append).get("prior", "", "3 mm", checked(SurfaceSection, "prior_sigma"))


OVER = {
    "side by side": (((40, 30, 10), (0, 0, 5)), ((10, 10, 10), (40, 0, 5)), False, 1300.0),
    "one on the other": (((40, 40, 10), (0, 0, 5)), ((20, 20, 10), (0, 0, 15)), False, 1600.0),
    "one in the other": (((40, 40, 20), (0, 0, 10)), ((20, 20, 10), (0, 0, 10)), True, 1600.0),
    "crossing": (((40, 30, 10), (0, 0, 5)), ((20, 20, 10), (15, 3, 9)), True, 1300.0),
    "tops in one plane": (((40, 30, 10), (0, 0, 5)), ((40, 20, 10), (25, 0, 5)), True, 1700.0),
}


@pytest.mark.parametrize("case", OVER)
def test_bodies_that_overlap_are_told_and_what_lies_double_counts_once(tmp_path, case: str):
    *boxes, overlap, area = OVER[case]
    made = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in boxes]
    path = tmp_path / "two.stl"
    trimesh.util.concatenate(made).export(path)
    told: list[str] = []
    laid, _ = laid_mesh(Asker({"unit": "mm"}, None, told.append), read_drawing(path))
    assert any("2 bodies that share no corner" in text for text in told)
    assert any("1 and 2 overlap" in text for text in told) is overlap
    corners = open_side(laid).vertices[open_side(laid).faces]
    seen = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2].sum()
    assert 1e6 * seen == pytest.approx(area, rel=0.005)
