"""Promises of a camera from pictures of a board that is bent."""

import numpy as np
import pytest

from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.solve.adjustment import Adjustment, Priors, shared_mask
from cell.measure.calibration.solve.intrinsics import choose_lens, moved_by_bend
from cell.measure.calibration.solve.joint import solve_staged, start_state, view_data
from cell.measure.calibration.solve.normal import HAND
from tests.support.recorded_scenes import MATRIX, scene


def test_what_a_bend_does_to_the_chain_is_what_it_moves():
    """Against the same scene with a flat board: the camera on the flange goes as far as was foretold."""
    found = []
    for bend in (0.0, 3e-4):
        frames = scene(seed=2, bend=bend, laser=False, arm_mm=0.02, arm_mrad=0.02)
        pictures, _ = choose_lens([frame.view for frame in frames])
        observations = [ScanObservation(f.view, None, f.base_from_flange, 0.0, f.name) for f in frames]
        staged = solve_staged(observations, stripe=False, camera=pictures.camera)
        views = [view_data(o, np.empty(0, dtype=np.intp)) for o in observations]
        adjustment = Adjustment(views, shared_mask(plane=False, rail=False), Priors(2e-5, 2e-5))
        found.append((adjustment, adjustment.solve(start_state(staged), 2).state))
    (_, flat), (adjustment, bent) = found
    foretold = moved_by_bend(adjustment, bent)
    turn = bent.flange_from_camera.rotation.T
    really = turn @ (flat.flange_from_camera.translation - bent.flange_from_camera.translation)
    assert np.linalg.norm(really) > 5e-4
    assert np.linalg.norm(foretold[HAND][:3] - really) < 0.15 * np.linalg.norm(really)
    assert foretold[0] == pytest.approx(flat.camera.fx - bent.camera.fx, rel=0.15)


@pytest.mark.parametrize("seed", [6, 8, 11])
def test_few_views_of_a_bent_board_state_how_little_they_tell(seed):
    """A bend of 0.2 mm that four views cannot tell moved the focal length by three times what was stated."""
    found, _ = choose_lens([f.view for f in scene(seed=seed, count=4, bend=2e-4, laser=False)])
    assert abs(found.camera.fx - MATRIX[0, 0]) < 2 * found.sigma[0] < 0.1 * MATRIX[0, 0]
