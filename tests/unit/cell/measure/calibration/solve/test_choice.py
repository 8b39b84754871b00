"""A camera that the arm contradicts is stated with what parts the two."""

from dataclasses import replace

import numpy as np

from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.solve.choice import choose_solution, with_doubt_of_camera
from cell.measure.calibration.solve.intrinsics import choose_lens
from cell.measure.calibration.solve.joint import solve_staged
from cell.measure.calibration.solve.normal import HAND
from tests.support.recorded_scenes import FLANGE_FROM_CAMERA, MATRIX, scene


def test_a_camera_that_the_arm_contradicts_is_stated_with_what_parts_them():
    """The pictures of a lens that was misjudged: 12 px off in focal length, and said to be known to 2 px."""
    frames = scene(seed=4, laser=False)
    honest, _ = choose_lens([frame.view for frame in frames])
    off = np.r_[12.0, 12.0, np.zeros(7)]
    camera = honest.camera.with_parameters(honest.camera.parameters + off)
    wrong = replace(honest, camera=camera, sigma=np.full(9, 2.0), covariance=np.diag(4 * [4.0] + 5 * [0.0]))
    observations = [ScanObservation(f.view, None, f.base_from_flange, 0.0, f.name) for f in frames]
    staged = solve_staged(observations, stripe=False, camera=wrong.camera)
    choice, doubted = with_doubt_of_camera(choose_solution(observations, staged, wrong), wrong)
    assert not choice.best.camera_free
    assert abs(doubted.camera.fx - MATRIX[0, 0]) < 2.5 * doubted.sigma[0] < 25.0
    hand = choice.best.adjusted.state.flange_from_camera.translation - FLANGE_FROM_CAMERA.translation
    assert np.all(np.abs(FLANGE_FROM_CAMERA.rotation.T @ hand) < 3.5 * choice.best.sigma[HAND][:3])
