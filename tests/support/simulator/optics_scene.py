"""What tests of the optics start from: cameras, boards, poses, and pictures without noise."""

import numpy as np
from scipy.spatial.transform import Rotation

from sim_backends.optics import Board, CameraOptics, Light, expected_image

FOCAL_PX = 8e-3 / 4.8e-6
LENS = (-0.08, 0.03, 4e-4, -3e-4, 0.01)
SCAN = CameraOptics(640, 480, FOCAL_PX, FOCAL_PX, 319.5, 239.5, LENS, transmission=0.4, vignetting=0.0)
TARGET = CameraOptics(1280, 1024, FOCAL_PX, FOCAL_PX, 639.5, 511.5, LENS, focus_distance=1.0, vignetting=0.0)
EVEN = Light(gradient=(0.0, 0.0), diffuse=1.0, surroundings=0.35)
FINE = Board.parse("marked_dots:11x9:3mm")
LARGE = Board.parse("marked_dots:9x7:20mm")


def pose(rotation_vector, translation=(0, 0, 0)):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def expose(optics, scene, exposure, laser=None, light=EVEN):
    return expected_image(optics, scene, laser, exposure, np.random.default_rng(0), light).astype(float)
