"""Promises of the simulated laser stripe: where it runs, how wide and bright it is, what shades it, what speckle does.

Truth is the intersection of planes projected by OpenCV, and the slow physical reference picture.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_backends.optics import (
    Board,
    BoardInstance,
    CameraOptics,
    LaserOptics,
    Light,
    Mesh,
    MeshInstance,
    PlaneInstance,
    expected_image,
    render,
)
from sim_backends.optics.laser.stripe import crossings

FOCAL_PX = 8e-3 / 4.8e-6
LENS = (-0.08, 0.03, 4e-4, -3e-4, 0.01)
OPTICS = CameraOptics(640, 480, FOCAL_PX, FOCAL_PX, 319.5, 239.5, LENS, transmission=0.4)
MATRIX = np.array([[FOCAL_PX, 0, 319.5], [0, FOCAL_PX, 239.5], [0, 0, 1.0]])
LASER = LaserOptics()
CLEAN = replace(LASER, speckle_contrast=0.0)
DARK = Light(level=0.0)
EXPOSURE = 0.002
COLUMNS = np.arange(640)


def facing(tilt, distance):
    """Pose of a surface frame whose z points at the camera when `tilt` (rotation vector) is zero."""
    matrix = np.eye(4)
    matrix[:3, :3] = (Rotation.from_rotvec(tilt) * Rotation.from_euler("x", np.pi)).as_matrix()
    matrix[:3, 3] = [0.0, 0.0, distance]
    return matrix


def height_field(height, columns=142, rows=72, size=(0.070, 0.036)):
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, columns) * size[0], np.linspace(-0.5, 0.5, rows) * size[1])
    vertices = np.column_stack([x.ravel(), y.ravel(), height(x, y).ravel()])
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.column_stack([first, first + 1, first + columns])
    upper = np.column_stack([first + 1, first + columns + 1, first + columns])
    return Mesh(vertices, np.vstack([lower, upper]))


def stripe(scene, laser=CLEAN, optics=OPTICS, seed=0):
    image = expected_image(optics, scene, laser, EXPOSURE, np.random.default_rng(seed), DARK)
    return image.astype(float)


def centroids(image):
    light = image.sum(axis=1)
    return (image * COLUMNS[: image.shape[1]]).sum(axis=1) / np.where(light > 0, light, np.nan), light


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


def test_brightness_follows_exposure_distance_incidence_and_albedo():
    def peak(distance, albedo, exposure, tilt=0.0):
        image = expected_image(
            OPTICS,
            [PlaneInstance(facing([0.0, tilt, 0.0], distance), (0.2, 0.2), albedo)],
            CLEAN,
            exposure,
            np.random.default_rng(0),
            DARK,
        )
        return image[240].sum()

    reference = peak(0.130, 0.9, 0.002)
    assert peak(0.130, 0.9, 0.004) == pytest.approx(2 * reference, rel=1e-4)
    assert peak(0.130, 0.3, 0.002) == pytest.approx(reference / 3, rel=1e-4)
    # Light in a row: the line is 1/R as bright per length and its image 1/Z as wide.
    assert peak(0.140, 0.9, 0.002) == pytest.approx(reference * (0.130 / 0.140) ** 2, rel=0.01)


def test_a_white_facing_surface_at_the_stand_off_has_a_usable_peak():
    peaks = stripe([PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.9)]).max(axis=1)
    assert peaks.min() >= 150
    assert peaks.max() <= 200


def test_what_stands_in_the_sheet_takes_the_light_from_behind_it():
    floor = PlaneInstance(facing([0, 0, 0], 0.140), (0.2, 0.2), 0.5)
    in_the_sheet = facing([0, 0, 0], 0.060)
    in_the_sheet[0, 3] = -0.035 + 0.060 / 3.5
    image = stripe([floor, PlaneInstance(in_the_sheet, (0.010, 0.010), 0.5)]).sum(axis=1)
    assert (stripe([floor]).sum(axis=1) > 50).all()
    assert (image[230:250] < 1).all()
    assert (image[:60] > 50).all()


def test_a_wall_between_camera_and_stripe_hides_it():
    floor = height_field(lambda x, y: 0 * x)
    seen = MeshInstance(facing([0, 0, 0], 0.130), floor, 0.6)
    screen = facing([0, 0, 0], 0.050)
    screen[:3, 3] += [0.001, 0.0, 0.0]
    image = stripe([seen, PlaneInstance(screen, (0.004, 0.005), 0.0)])
    assert (image[225:255].sum(axis=1) < 1).all()
    assert (image[80:120].sum(axis=1) > 50).all()


def test_a_laser_beside_the_camera_s_row_draws_two_peaks_under_a_ledge():
    # From 20 mm to the side the sheet reaches 3.3 mm under the ledge's rim, 20 mm above the floor at 140 mm.
    beside = replace(CLEAN, origin=(-0.035, -0.020, 0.0))
    floor = PlaneInstance(facing([0, 0, 0], 0.140), (0.2, 0.2), 0.5)
    over = facing([0, 0, 0], 0.120)
    over[:3, 3] += [-0.035 + 0.120 / 3.5, 0.010, 0.0]
    image = stripe([floor, PlaneInstance(over, (0.004, 0.020), 0.5)], beside)
    peaks = (image[:, 1:-1] > image[:, :-2]) & (image[:, 1:-1] >= image[:, 2:]) & (image[:, 1:-1] > 20)
    doubled = np.flatnonzero(peaks.sum(axis=1) == 2)
    assert len(doubled) == pytest.approx(0.020 * 0.020 / 0.120 / 0.140 * FOCAL_PX, abs=2)
    assert doubled[0] == pytest.approx(240, abs=1)


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


def test_speckle_moves_centres_by_what_recordings_show():
    scene = [PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.9)]
    quiet = centroids(stripe(scene))[0]
    shifts = np.concatenate([centroids(stripe(scene, LASER, seed=s))[0] - quiet for s in range(6)])
    assert 0.05 < shifts.std() < 0.08
    assert abs(shifts.mean()) < 0.005
    ratio = stripe(scene, LASER, seed=1) / np.maximum(stripe(scene), 1e-9)
    bright = stripe(scene) > 20
    assert ratio[bright].std() == pytest.approx(LASER.speckle_contrast, rel=0.1)
    assert ratio[bright].mean() == pytest.approx(1.0, abs=0.02)


def test_speckle_is_correlated_between_neighbours_and_new_in_every_frame():
    scene = [PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.9)]
    quiet = centroids(stripe(scene))[0]
    first, second = (centroids(stripe(scene, LASER, seed=s))[0] - quiet for s in (1, 2))
    assert np.corrcoef(first[1:], first[:-1])[0, 1] > 0.1
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.15


def test_the_stripe_saturates_and_the_laser_can_be_off():
    scene = [PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.9)]
    rng = np.random.default_rng(0)
    assert (render(OPTICS, scene, LASER, 0.008, rng).max(axis=1) == 255).all()
    assert render(OPTICS, scene, None, 0.002, rng).max() < 40


def test_the_fan_ends():
    narrow = replace(CLEAN, fan=np.deg2rad(3.0))
    light = stripe([PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.9)], narrow).sum(axis=1)
    half = np.tan(np.deg2rad(3.0)) * np.hypot(0.130, 0.130 / 3.5) / 0.130 * FOCAL_PX
    assert (light > 0).sum() == pytest.approx(2 * half, abs=4)


def test_a_mesh_that_stands_on_a_plane_covers_it():
    # Where mesh and table touch, the stripe must not be drawn twice.
    table = PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.6)
    touching = MeshInstance(facing([0, 0, 0], 0.130), height_field(lambda x, y: 0 * x), 0.6)
    alone = stripe([touching]).sum(axis=1)
    assert np.allclose(stripe([table, touching]).sum(axis=1)[100:380], alone[100:380])


def test_wrong_meshes_and_exposures_are_refused():
    with pytest.raises(ValueError, match="triangle"):
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 3]]))
    with pytest.raises(ValueError, match="exposure"):
        expected_image(OPTICS, [], None, 0.0, np.random.default_rng(0))
