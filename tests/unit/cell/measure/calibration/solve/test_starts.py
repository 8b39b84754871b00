"""Promises of the closed forms that the adjustment starts from: hand-eye, and the light plane by the paper's steps."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cell.measure.calibration.solve.starts import Crossing, at_cross_ratio, paper_plane, refine_hand_eye, solve_hand_eye
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.poses import difference, from_matrix, from_parts, perturbed
from cell.measure.vision.board.view import BoardView
from drivers.errors import RefusedError
from lab.bench.calibration.campaign import observe
from lab.bench.calibration.world import Noise


def test_hand_eye_needs_turns_about_two_axes():
    flanges = [from_parts((0.1 * k, 0, 0.5), pin.exp3(np.array([0, 0, 0.3 * k]))) for k in range(6)]
    hand, board = pin.SE3.Random(), pin.SE3.Random()
    with pytest.raises(RefusedError, match="two different axes"):
        solve_hand_eye(flanges, [hand.inverse() * f.inverse() * board for f in flanges])


def test_hand_eye_and_rail_come_out_of_exact_poses():
    rng = np.random.default_rng(8)
    hand, board, along = pin.SE3.Random(), pin.SE3.Random(), np.array([0.9995, 0.004, -0.003])
    flanges = [pin.SE3(pin.exp3(rng.uniform(-1, 1, 3)), rng.uniform(-0.5, 0.5, 3)) for _ in range(8)]
    rail = rng.uniform(0, 0.1, 8)
    seen = [(f * hand * from_parts(s * along)).inverse() * board for f, s in zip(flanges, rail, strict=True)]
    found = solve_hand_eye(flanges, seen, list(rail))
    np.testing.assert_allclose(found.flange_from_camera.homogeneous, hand.homogeneous, atol=1e-9)
    np.testing.assert_allclose(found.rail_direction, along, atol=1e-8)
    assert found.scatter_m < 1e-9


def test_refined_hand_eye_shrugs_off_a_wrong_pair():
    rng = np.random.default_rng(4)
    hand, board = pin.SE3.Random(), pin.SE3.Random()
    flanges = [pin.SE3(pin.exp3(rng.uniform(-1, 1, 3)), rng.uniform(-0.5, 0.5, 3)) for _ in range(30)]
    seen = [perturbed((f * hand).inverse() * board, 1e-4 * rng.normal(size=6)) for f in flanges]
    seen[7] = perturbed(seen[7], (0.05, 0, 0, 0, 0.1, 0))
    found, _, _ = refine_hand_eye(flanges, seen, solve_hand_eye(flanges, seen))
    assert np.linalg.norm(difference(found.flange_from_camera, hand)) < 5e-4


def test_the_paper_s_steps_find_the_plane_of_exact_views(world):
    noise = replace(Noise(), dots=1e-9, stripe=1e-9, rail=1e-12, arm=1e-12, arm_angle=1e-12)
    exact = observe(world, noise, np.random.default_rng(3))
    camera = CameraModel(640, 480, 1.0, 1.0, 0.0, 0.0).with_parameters(world.lens)
    poses = [from_matrix(world.camera_from_board(k, np.zeros(7))) for k in range(len(exact))]
    stripes = [o.profile.pixels()[200:300] for o in exact]
    plane, rms = paper_plane(camera, list(zip(poses, [o.view for o in exact], stripes, strict=True)))
    # The stripe's line is fitted without the print's rows left out, and the lens bends it by nothing that is left.
    np.testing.assert_allclose(plane.n / plane.distance, world.plane, rtol=1e-4, atol=2e-3)
    assert rms < 2e-6


def test_three_dots_give_the_cross_ratio(world):
    view = BoardView(world.spec, (640, 480), np.array([0, 4, 10]), np.zeros((3, 2)), np.ones(3))
    x = view.object_points[:, 0]
    t = np.array([0.1, 0.25, 0.6])
    place = 0.4
    got = at_cross_ratio(Crossing(np.array([place, 0.0]), np.arange(3), 0), view, np.column_stack([t, np.zeros(3)]))[0]

    def ratio(a, b, c, d):
        return (c - a) * (d - b) / ((c - b) * (d - a))

    assert ratio(*x, got) == pytest.approx(ratio(*t, place), rel=1e-9)
