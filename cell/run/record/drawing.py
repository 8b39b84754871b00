"""The cell as viewers draw it: frames from the joints, bodies as boxes and capsules, lenses, points.

Used by the thread that writes the record alone. Poses go out as they come in, in m and quaternions; frames are named
after what they are fixed to.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from numpy.typing import NDArray

from cell.measure.geometry.camera import CameraModel
from cell.motion.collision import Body
from cell.motion.kinematics import ArmKinematics
from cell.run.record.small import stamp
from drivers.interfaces import Vector

ROOT, BASE = "tf#/", "base"
"""`tf#/` is what rerun calls the frame of its own root."""
PARENTS = (BASE, *(f"joint_{k}" for k in range(1, 7)), "flange")
"""The frames that bodies hang on, by `Body.parent`."""
JOINTS = (
    "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint",
)  # fmt: skip
"""As the maker's own description of the arm names them."""
COLOURS = {
    "part": (0.95, 0.65, 0.10, 1.0),
    "placed part": (0.95, 0.65, 0.10, 1.0),
    "surface": (0.35, 0.65, 0.40, 0.5),
    "board": (0.90, 0.90, 0.90, 1.0),
    "scan head": (0.75, 0.20, 0.20, 0.8),
    "target camera": (0.20, 0.35, 0.75, 0.8),
}
GREY = (0.55, 0.58, 0.62, 0.6)


class Frames:
    """Where everything is, from what was read last of arm and rail.

    `mounts` are flange_from_camera by the cameras' names, the scan camera's with the rail at 0; `rail_direction` (3,)
    is the way of that camera in its own axes per metre of the rail.
    """

    def __init__(self, kinematics: ArmKinematics, mounts: dict[str, pin.SE3], rail_direction: Vector) -> None:
        self.joints: Vector | None = None
        self.rail = 0.0
        self._kinematics = kinematics
        self._mounts = mounts
        self._rail_direction = rail_direction

    def arm(self, at: int) -> bytes:
        """Root, base, joints, flange and target camera; nothing of the rail, whose readings have other times."""
        message = FrameTransforms()
        self._add(message, at, ROOT, BASE, pin.SE3.Identity())
        if self.joints is not None:
            for k, placement in enumerate(self._kinematics.placements(self.joints)):
                self._add(message, at, PARENTS[k], PARENTS[k + 1], placement)
        self._add(message, at, "flange", "target_camera", self._mounts["target_camera"])
        return bytes(message.SerializeToString())

    def scan_camera(self, at: int) -> bytes:
        """The scan camera on the flange, with the rail where it was read last."""
        message = FrameTransforms()
        carried = self.rail * self._rail_direction
        mount = self._mounts["scan_camera"] * pin.SE3(np.eye(3), carried)
        self._add(message, at, "flange", "scan_camera", mount)
        return bytes(message.SerializeToString())

    def arm_joints(self, at: int, speeds: Vector) -> bytes:
        """The arm's joints as they were read last."""
        message = JointStates()
        stamp(message, at)
        for name, angle, speed in zip(JOINTS, [] if self.joints is None else self.joints, speeds, strict=False):
            message.joints.add(name=name, position=float(angle), velocity=float(speed))
        return bytes(message.SerializeToString())

    def rail_joint(self, at: int) -> bytes:
        """The rail as it was read last."""
        message = JointStates()
        stamp(message, at)
        message.joints.add(name="rail", position=self.rail)
        return bytes(message.SerializeToString())

    @staticmethod
    def _add(message: Any, at: int, parent: str, child: str, pose: pin.SE3) -> None:
        transform = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
        stamp(transform, at)
        _set(transform.translation, transform.rotation, pose)


def scene(at: int, bodies: Sequence[Body], gone: Sequence[str] = ()) -> bytes:
    """These bodies, each fixed to the frame that carries it, and those that are `gone`, by name."""
    message = SceneUpdate()
    for name in gone:
        deletion = message.deletions.add(type=SceneEntityDeletion.MATCHING_ID, id=name)
        stamp(deletion, at)
    for body in bodies:
        entity = message.entities.add(id=body.name, frame_id=PARENTS[body.parent], frame_locked=True)
        stamp(entity, at)
        colour = dict(zip("rgba", COLOURS.get(body.name, GREY), strict=True))
        if body.radius is None:
            _solid(entity.cubes.add(), body.placement, body.size, colour)
            continue
        across, length = 2 * body.radius, body.size[2]
        _solid(entity.cylinders.add(bottom_scale=1.0, top_scale=1.0), body.placement, (across, across, length), colour)
        for end in (-0.5, 0.5):
            cap = body.placement * pin.SE3(np.eye(3), np.array([0.0, 0.0, end * length]))
            _solid(entity.spheres.add(), cap, (across, across, across), colour)
    return bytes(message.SerializeToString())


def lens(at: int, name: str, camera: CameraModel) -> bytes:
    """A camera's lens and sensor."""
    message = CameraCalibration(
        frame_id=name, width=camera.width, height=camera.height, distortion_model="plumb_bob", D=camera.dist
    )
    stamp(message, at)
    message.K.extend(camera.matrix.ravel().tolist())
    message.R.extend(np.eye(3).ravel().tolist())
    message.P.extend(np.hstack([camera.matrix, np.zeros((3, 1))]).ravel().tolist())
    return bytes(message.SerializeToString())


def cloud(at: int, points: NDArray[np.float32]) -> bytes:
    """Points (n, 3) in m in the arm's base; they go out in single precision."""
    message = PointCloud(frame_id=BASE, point_stride=12, data=np.ascontiguousarray(points, dtype="<f4").tobytes())
    stamp(message, at)
    message.pose.orientation.w = 1.0
    for k, name in enumerate("xyz"):
        message.fields.add(name=name, offset=4 * k, type=PackedElementField.FLOAT32)
    return bytes(message.SerializeToString())


def _solid(primitive: Any, pose: pin.SE3, size: Sequence[float], colour: dict[str, float]) -> None:
    _set(primitive.pose.position, primitive.pose.orientation, pose)
    primitive.size.x, primitive.size.y, primitive.size.z = map(float, size)
    for name, value in colour.items():
        setattr(primitive.color, name, value)


def _set(translation: Any, rotation: Any, pose: pin.SE3) -> None:
    translation.x, translation.y, translation.z = pose.translation.tolist()
    rotation.x, rotation.y, rotation.z, rotation.w = pin.Quaternion(pose.rotation).coeffs().tolist()
