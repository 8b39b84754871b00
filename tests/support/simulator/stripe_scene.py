"""A scan camera, its laser line, and the light that the line puts on a scene."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sim_backends.optics import CameraOptics, LaserOptics, Light, Mesh, expected_image
from tests.support.simulator.optics_scene import FOCAL_PX, LENS

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
