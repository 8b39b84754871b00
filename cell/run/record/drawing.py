"""The messages of a record as viewers draw them: frames from the joints, bodies, lenses, pictures, points, the log.

Used by the thread that writes the record alone, which loads the packages for it as well. Poses go out as they come in,
in m and quaternions; frames are named after what they are fixed to.
"""

import logging
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from numpy.typing import NDArray

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import CellConfig
from cell.devices.devices import Devices
from cell.motion.collision import Body
from cell.motion.kinematics import ArmKinematics, arm_kinematics
from cell.procedures.frame_store import FrameFile
from cell.run.record.file import CAMERAS
from drivers.errors import CellError
from drivers.interfaces import ArmState, Vector

ROOT, BASE = "tf#/", "base"
"""`tf#/` is what rerun calls the frame of its own root."""
PARENTS = (BASE, *(f"joint_{k}" for k in range(1, 7)), "flange")
"""The frames that bodies hang on, by `Body.parent`."""
JOINTS = (
    "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint",
)  # fmt: skip
"""As the maker's own description of the arm names them."""
COLOURS = {
    "part": (0.95, 0.65, 0.10, 1.0), "placed part": (0.95, 0.65, 0.10, 1.0), "surface": (0.35, 0.65, 0.40, 0.5),
    "board": (0.90, 0.90, 0.90, 1.0), "scan head": (0.75, 0.20, 0.20, 0.8), "target camera": (0.20, 0.35, 0.75, 0.8),
}  # fmt: skip
GREY = (0.55, 0.58, 0.62, 0.6)
PICTURE_S = 10.0
"""Wall seconds that a picture may take to be encoded before its message is left out."""


class RecordDrawing:
    """Makes the messages of one run; each method gives the bytes of one with its time `at`, ns.

    It remembers the joints and the rail as they were told last. Cameras are where the `calibration` has them, without
    one where the configuration has them.
    """

    def __init__(self, config: CellConfig, devices: Devices, calibration: CellCalibration | None) -> None:
        self._model, self._devices = config.arm.model, devices
        self._calibration = calibration
        if calibration is not None:
            mounts = [calibration.scan.flange_from_camera, calibration.target.flange_from_camera]
            self._rail_direction: Vector = np.asarray(calibration.scan.rail_direction)
        else:
            mounts = [getattr(config, name).flange_from_camera.se3() for name in CAMERAS]
            self._rail_direction = np.array([1.0, 0.0, 0.0])
        self._mounts: dict[str, pin.SE3] = dict(zip(CAMERAS, mounts, strict=True))
        self._joints: Vector | None = None
        self._rail = 0.0

    @cached_property
    def _kinematics(self) -> ArmKinematics:
        """Made when the joints are drawn first: what is wrong with the arm's table takes no other message away."""
        try:
            told = self._devices.arm.link_table() if "arm" in self._devices else None
        except CellError:
            told = None
        return arm_kinematics(self._model, told)

    def arm(self, at: int, state: ArmState | None = None) -> bytes:
        """Root, base, joints, flange and target camera; nothing of the rail, whose readings have other times."""
        if state is not None:
            self._joints = state.joints
        message = FrameTransforms()
        _add(message, at, ROOT, BASE, pin.SE3.Identity())
        if self._joints is not None:
            for k, placement in enumerate(self._kinematics.placements(self._joints)):
                _add(message, at, PARENTS[k], PARENTS[k + 1], placement)
        _add(message, at, "flange", "target_camera", self._mounts["target_camera"])
        return bytes(message.SerializeToString())

    def scan_camera(self, at: int, position: float) -> bytes:
        """The scan camera on the flange, with the rail at this position."""
        self._rail = position
        message = FrameTransforms()
        carried = self._rail * self._rail_direction
        _add(message, at, "flange", "scan_camera", self._mounts["scan_camera"] * pin.SE3(np.eye(3), carried))
        return bytes(message.SerializeToString())

    def arm_joints(self, at: int, speeds: Vector) -> bytes:
        """The arm's joints as they were read last."""
        message = _stamped(JointStates(), at)
        for name, angle, speed in zip(JOINTS, [] if self._joints is None else self._joints, speeds, strict=False):
            message.joints.add(name=name, position=float(angle), velocity=float(speed))
        return bytes(message.SerializeToString())

    def rail_joint(self, at: int) -> bytes:
        """The rail as it was read last."""
        message = _stamped(JointStates(), at)
        message.joints.add(name="rail", position=self._rail)
        return bytes(message.SerializeToString())

    def scene(self, at: int, bodies: Sequence[Body], gone: Sequence[str]) -> bytes:
        """These bodies, each fixed to the frame that carries it, and those that are `gone`, by name."""
        message = SceneUpdate()
        for name in gone:
            _stamped(message.deletions.add(type=SceneEntityDeletion.MATCHING_ID, id=name), at)
        for body in bodies:
            entity = message.entities.add(id=body.name, frame_id=PARENTS[body.parent], frame_locked=True)
            _stamped(entity, at)
            colour = dict(zip("rgba", COLOURS.get(body.name, GREY), strict=True))
            if body.radius is None:
                _solid(entity.cubes.add(), body.placement, body.size, colour)
                continue
            wide, length = 2 * body.radius, body.size[2]
            _solid(entity.cylinders.add(bottom_scale=1.0, top_scale=1.0), body.placement, (wide, wide, length), colour)
            for end in (-0.5, 0.5):
                cap = body.placement * pin.SE3(np.eye(3), np.array([0.0, 0.0, end * length]))
                _solid(entity.spheres.add(), cap, (wide, wide, wide), colour)
        return bytes(message.SerializeToString())

    def lens(self, at: int, name: str) -> bytes | None:
        """A camera's lens and sensor; None without a calibration."""
        if (found := self._calibration) is None:
            return None
        camera = (found.scan if name == "scan_camera" else found.target).camera
        message = CameraCalibration(
            frame_id=name, width=camera.width, height=camera.height, distortion_model="plumb_bob", D=camera.dist
        )
        _stamped(message, at)
        message.K.extend(camera.matrix.ravel().tolist())
        message.R.extend(np.eye(3).ravel().tolist())
        message.P.extend(np.hstack([camera.matrix, np.zeros((3, 1))]).ravel().tolist())
        return bytes(message.SerializeToString())

    def image(self, at: int, camera: str, picture: FrameFile) -> bytes | None:
        """A camera's picture as its file has it; None where there is none."""
        if (png := picture.png(PICTURE_S)) is None:
            return None
        return bytes(_stamped(CompressedImage(frame_id=camera, data=png, format="png"), at).SerializeToString())

    def cloud(self, at: int, points: NDArray[np.float32]) -> bytes:
        """Points (n, 3) in m in the arm's base; they go out in single precision."""
        message = PointCloud(frame_id=BASE, point_stride=12, data=np.ascontiguousarray(points, dtype="<f4").tobytes())
        _stamped(message, at).pose.orientation.w = 1.0
        for k, name in enumerate("xyz"):
            message.fields.add(name=name, offset=4 * k, type=PackedElementField.FLOAT32)
        return bytes(message.SerializeToString())

    def log_line(self, at: int, record: logging.LogRecord, text: str) -> bytes:
        """A line of the log; its level is a tenth of Python's."""
        level: Any = min(record.levelno // 10, 5)
        message = Log(level=level, message=text, name=record.name, file=record.filename, line=record.lineno)
        return bytes(_stamped(message, at).SerializeToString())


def _stamped(message: Any, at: int) -> Any:
    message.timestamp.seconds, message.timestamp.nanos = divmod(at, 1_000_000_000)
    return message


def _add(message: Any, at: int, parent: str, child: str, pose: pin.SE3) -> None:
    transform = _stamped(message.transforms.add(parent_frame_id=parent, child_frame_id=child), at)
    _set(transform.translation, transform.rotation, pose)


def _solid(primitive: Any, pose: pin.SE3, size: Sequence[float], colour: dict[str, float]) -> None:
    _set(primitive.pose.position, primitive.pose.orientation, pose)
    primitive.size.x, primitive.size.y, primitive.size.z = map(float, size)
    for name, value in colour.items():
        setattr(primitive.color, name, value)


def _set(translation: Any, rotation: Any, pose: pin.SE3) -> None:
    translation.x, translation.y, translation.z = pose.translation.tolist()
    rotation.x, rotation.y, rotation.z, rotation.w = pin.Quaternion(pose.rotation).coeffs().tolist()
