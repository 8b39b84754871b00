"""What the sweep of a job looks for, and what keeps a part from being unloaded."""

from pathlib import Path

import numpy as np
import pytest

from cell.check.fit import require_fit
from cell.config.cell_config import load_config
from cell.config.job import Job, load_job
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.part_pose import seen_from_below
from cell.procedures.sought_part import nominal_of, sought
from drivers.errors import ConfigError
from drivers.make import Mounting
from tests.support.unloading import JOB, MESH

CONFIG = load_config(None)


def changed(**update: object) -> Job:
    return JOB.model_copy(update=update)


def test_a_part_to_be_unloaded_is_sought_by_its_upper_side_where_it_lies():
    aside = JOB.place.surface_from_part.model_copy(update={"translation": (0.004, 0.0, 0.001)})
    found, file = sought(changed(place=JOB.place.model_copy(update={"surface_from_part": aside})), MESH)
    assert JOB.part is not None and file == Path(JOB.part.mesh)
    assert np.allclose(found.surface.place_from_surface.translation, (0.004, 0.0, 0.001))
    assert found.place.surface_from_part.translation == (0.0, 0.0, 0.0)
    faces = nominal_of(found, file)
    whole = NominalSurface.load(file, unit=JOB.part.mesh_unit)
    assert (faces.normals[:, 2] > 0.3).all() and len(faces.triangles) < len(whole.triangles)
    # The scan head keeps its distance from the middle of what it sweeps.
    assert found.scan.stand_off - JOB.scan.stand_off == pytest.approx(0.5 * sum(faces.extent)[2])
    assert sought(found, file) == (found, file), "once is enough"


def test_a_part_on_one_like_it_is_sought_where_it_lies():
    assert JOB.part is not None
    higher = JOB.place.surface_from_part.model_copy(update={"translation": (0.0, 0.0, 0.02)})
    place = JOB.place.model_copy(update={"surface_from_part": higher})
    surface = JOB.surface.model_copy(update={"mesh": JOB.part.mesh})
    found, file = sought(changed(place=place, surface=surface), Path(JOB.part.mesh))
    assert np.allclose(found.surface.place_from_surface.translation, (0.0, 0.0, 0.02))
    assert sought(found, file) == (found, file)


def test_other_jobs_seek_their_surface():
    for name in ("pot", "shell"):
        job, mesh = load_job(name)
        assert sought(job, mesh) == (job, mesh)
        assert len(nominal_of(job, mesh).triangles) == len(NominalSurface.load(mesh, unit="m").triangles)


def test_the_underside_of_a_part_is_the_ground_that_fits_it():
    assert JOB.part is not None
    part, ground = (NominalSurface.load(file, unit="m") for file in (Path(JOB.part.mesh), MESH))
    below = seen_from_below(part, JOB.place.surface_from_part.se3())
    assert (below.normals[:, 2] > 0.3).all()
    assert np.nanmax(np.abs(ground.deviations(below.samples))) < 1e-5


FAR = Mounting.model_construct(translation=(-1.0, 0.9, 0.0), rotation=(0, 0, 0))


@pytest.mark.parametrize(
    ("job", "told"),
    [
        (changed(nest=None), r'job\.kind "unload" finds the part by its mesh .*give \[part\] and \[nest\]'),
        (changed(part=None), r"give \[part\] and \[nest\]"),
        (changed(job=JOB.job.model_copy(update={"kind": "place"})), r'\[nest\]: job\.kind "place" has no use for it'),
        (changed(nest=JOB.nest and JOB.nest.model_copy(update={"base_from_part": FAR})), r"nest\.base_from_part"),
    ],
)
def test_what_keeps_a_part_from_its_nest_is_told_before_anything_moves(job: Job, told: str):
    require_fit(JOB, CONFIG, MESH)
    with pytest.raises(ConfigError, match=told):
        require_fit(job, CONFIG, MESH)
