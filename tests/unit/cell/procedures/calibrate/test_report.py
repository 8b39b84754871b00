"""How good a calibration is: what its report says of noise and of the place, and draws."""

import cv2
import numpy as np
import pytest

from cell.config.calibrations.store import gathered, solve_observations
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.measure.inversion import NominalSurface
from cell.procedures.calibrate.report import Examination, examine, places_of_job
from lab.bench.calibration.observed_cell import ObservedCell
from sim_backends.world.scene import draw

CONFIG = load_config(None)


@pytest.fixture(scope="module")
def examined() -> Examination:
    """A calibration of a world whose noise is what is assumed."""
    cell = ObservedCell(draw(2, "nominal"), CONFIG, np.random.default_rng([2, 7]))
    seen = gathered(cell.collect_scan(), cell.collect_target(), {"arm": "1"}, CONFIG)
    solved = solve_observations(seen)
    job, mesh = load_job("pot")
    places = places_of_job(CONFIG, job, NominalSurface.load(mesh, unit=job.surface.mesh_unit), solved.calibration.scan)
    # The carriage stands where the light plane goes through the point, and the camera sees the point there.
    head = solved.calibration.scan
    on_plane = head.light_plane.intersect(head.camera.rays(places.pixels))
    assert head.camera.project(on_plane) == pytest.approx(places.pixels, abs=1e-6)
    assert len(places.pixels) == 45
    assert np.ptp(places.rails) == pytest.approx(0.07, abs=0.02), "as far as the part is long"
    return examine(solved, seen, CONFIG, "pot")


def test_the_residuals_speak_of_the_noise_that_there_is(examined: Examination):
    noise = examined.summary["noise_found"]
    assert (noise["dots"], noise["chi2_per_dof"]) == pytest.approx((1.0, 1.0), abs=0.3)
    assert all(not check["suspect"] for check in examined.summary["checks"] if "suspect" in check)


def test_what_limits_the_place_is_no_more_than_all_of_it_and_what_is_added_betters_it(examined: Examination):
    influence, advice = examined.summary["influence"], examined.summary["advice"]
    assert influence["points"] == 45
    assert all(row["if_known_mm"] <= influence["total_mm"] * (1 + 1e-9) for row in influence["parameters"])
    assert all(row["then_mm"] <= influence["total_mm"] * (1 + 1e-9) for row in advice)


def test_three_pictures_are_drawn(examined: Examination, tmp_path):
    for path in examined.draw(tmp_path / "pictures"):
        picture = cv2.imread(str(path))
        assert min(picture.shape[:2]) > 600 and picture.std() > 10
