"""Simulated optics: what the cell's cameras see of boards, planes, meshes and the laser line. Pure functions.

Knows nothing of devices or of the controller; shares no projection, plane or noise code with the estimator.
"""

from sim_backends.optics.camera import CameraOptics, sensor
from sim_backends.optics.mesh import Mesh
from sim_backends.optics.render import expected_image, render
from sim_backends.optics.scene import Board, BoardInstance, LaserOptics, Light, MeshInstance, PlaneInstance, SceneObject

__all__ = [
    "Board", "BoardInstance", "CameraOptics", "LaserOptics", "Light", "Mesh", "MeshInstance", "PlaneInstance",
    "SceneObject", "expected_image", "render", "sensor",
]  # fmt: skip
