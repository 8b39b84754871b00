"""Observations of a scan head that is drawn independently of the estimators, and their calibration."""

import numpy as np
import pytest

from cell.config.calibrations.store import nominal_camera, solve_observations
from cell.config.cell_config import load_config
from cell.measure.calibration import ScanCalibration, TargetObservation
from cell.measure.calibration.archive import Observations
from cell.measure.calibration.solve.results import adjust_scan
from cell.measure.geometry.poses import from_parts
from lab.bench.calibration.campaign import observe
from lab.bench.calibration.world import Noise, draw_head

NOISE = Noise()


@pytest.fixture(scope="session")
def world():
    return draw_head(np.random.default_rng(1))


@pytest.fixture(scope="session")
def archived(world) -> Observations:
    scan = observe(world, NOISE, np.random.default_rng(2))
    config = load_config(None)
    camera = nominal_camera(config.scan_camera)
    priors = NOISE.priors
    # The same views serve a camera without a rail, on a flange that went where the carriage had gone.
    head = ScanCalibration.of(adjust_scan(scan, camera, np.array([1.0, 0.0, 0.0]), priors))
    along = head.flange_from_camera.rotation @ head.rail_direction
    target = [TargetObservation(o.view, o.base_from_flange * from_parts(o.rail_position * along), o.name) for o in scan]
    return Observations(scan, target, camera, camera, priors, 2e-3, {"arm": "A1", "rail": "R1"}, "abc", 1.7e9)


@pytest.fixture(scope="session")
def solved(archived):
    return solve_observations(archived)
