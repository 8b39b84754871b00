"""Promises of the simulated laser stripe: where it runs. Truth is the intersection of planes projected by OpenCV."""

import cv2
import numpy as np
import pytest

from sim_backends.optics import Board, BoardInstance, MeshInstance, PlaneInstance
from sim_backends.optics.laser.stripe import crossings
from tests.support.simulator.stripe_scene import LASER, LENS, MATRIX, OPTICS, centroids, facing, height_field, stripe


@pytest.mark.parametrize("tilt", [[0.0, 0.0, 0.0], [0.35, 0.0, 0.0], [0.0, -0.5, 0.0], [0.2, 0.4, 0.3]])
def test_stripe_on_a_plane_runs_where_the_two_planes_meet(tilt):
    camera_from_plane = facing(tilt, 0.130)
    seen, light = centroids(stripe([PlaneInstance(camera_from_plane, (0.2, 0.2), 0.9)]))
    normal, distance = np.array(LASER.normal), LASER.distance
    plane, offset = camera_from_plane[:3, 2], camera_from_plane[:3, 2] @ camera_from_plane[:3, 3]
    along = np.cross(normal, plane)
    anchor = np.linalg.solve(np.stack([normal, plane, along]), [distance, offset, 0.0])
    line = anchor + np.linspace(-0.1, 0.1, 20001)[:, None] * along / np.linalg.norm(along)
    pixels = cv2.projectPoints(line, np.zeros(3), np.zeros(3), MATRIX, np.array(LENS))[0][:, 0]
    order = np.argsort(pixels[:, 1])
    truth = np.interp(np.arange(480), pixels[order, 1], pixels[order, 0])
    assert (light > 50).all()
    assert np.abs(seen - truth).max() < 0.002


def test_crossings_lie_on_the_light_plane_on_the_mesh_and_on_the_row():
    instance = MeshInstance(facing([0.1, 0.05, 0.0], 0.135), height_field(lambda x, y: 5 * x * x + 0.1 * y), 0.6)
    found = crossings(OPTICS, LASER, instance)
    assert np.abs(found.points @ np.array(LASER.normal) - LASER.distance).max() < 1e-9
    pixels = cv2.projectPoints(found.points.copy(), np.zeros(3), np.zeros(3), MATRIX, np.array(LENS))[0][:, 0]
    assert np.abs(pixels - np.column_stack([found.columns, found.rows])).max() < 1e-5
    pose = instance.camera_from_mesh
    local = (found.points - pose[:3, 3]) @ pose[:3, :3]
    assert np.abs(local[:, 2] - 5 * local[:, 0] ** 2 - 0.1 * local[:, 1]).max() < 5 * (0.070 / 141) ** 2


def test_dots_darken_the_stripe():
    board = Board.parse("marked_dots:11x9:3mm")
    pose = np.eye(4)
    pose[:3, 3] = [-0.015, -0.012, 0.1225]
    image = stripe([BoardInstance(pose, board)])
    light = image.sum(axis=1)
    rows = OPTICS.project(board.points + pose[:3, 3])[:, 1].reshape(9, 11)[:, 5]
    gaps = (rows[1:] + rows[:-1]) / 2
    on_dots = light[np.rint(rows[[0, 1, 2, 6, 7, 8]]).astype(int)]
    between = light[np.rint(gaps).astype(int)]
    assert on_dots.max() < 0.12 * between.min()
