"""The messages of a record as the thread that writes it makes them; the packages for that are loaded there, too.

It remembers the joints and the rail as they were told last, because a message of all frames needs both.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import CellConfig
from cell.devices.devices import Devices
from cell.motion.collision import Body
from cell.motion.kinematics import arm_kinematics
from cell.procedures.frame_store import FrameFile
from cell.run.record.file import CAMERAS
from drivers.errors import CellError
from drivers.interfaces import ArmState

if TYPE_CHECKING:
    from cell.run.record.drawing import Frames

PICTURE_S = 10.0
"""Wall seconds that a picture may take to be encoded before its message is left out."""
MOST_POINTS = 60_000
"""Of a cloud that grows; of more, every so many are left out."""


class Sketch:
    """Makes the messages of one run; each method is called by the writer's thread and gives a message's bytes."""

    def __init__(self, config: CellConfig, devices: Devices, calibration: CellCalibration | None) -> None:
        self._config, self._devices, self._calibration = config, devices, calibration

    @cached_property
    def _frames(self) -> Frames:
        from cell.run.record.drawing import Frames

        try:
            told = self._devices.arm.link_table() if "arm" in self._devices else None
        except CellError:
            told = None
        kinematics = arm_kinematics(self._config.arm.model, told)
        if (found := self._calibration) is not None:
            mounts = [found.scan.flange_from_camera, found.target.flange_from_camera]
            direction = np.asarray(found.scan.rail_direction)
        else:
            mounts = [getattr(self._config, name).flange_from_camera.se3() for name in CAMERAS]
            direction = np.array([1.0, 0.0, 0.0])
        return Frames(kinematics, dict(zip(CAMERAS, mounts, strict=True)), direction)

    def arm_at(self, at: int, state: ArmState) -> bytes:
        """The arm's frames, as it is in this state."""
        self._frames.joints = state.joints
        return self._frames.arm(at)

    def rail_at(self, at: int, position: float) -> bytes:
        """The scan camera's frame, with the rail at this position."""
        self._frames.rail = position
        return self._frames.scan_camera(at)

    def arm_joints(self, at: int, state: ArmState) -> bytes:
        """The arm's joints as they are in this state."""
        return self._frames.arm_joints(at, state.joint_speeds)

    def rail_joint(self, at: int) -> bytes:
        """The rail as it was told last."""
        return self._frames.rail_joint(at)

    def arm_frames(self, at: int) -> bytes:
        """The arm's frames as they are known."""
        return self._frames.arm(at)

    def scene(self, at: int, new: Sequence[Body], gone: Sequence[str]) -> bytes:
        """Bodies that are new, or elsewhere, and those that are gone."""
        from cell.run.record import drawing

        return drawing.scene(at, new, gone)

    def lens(self, at: int, camera: str) -> bytes | None:
        """A camera's calibration; None where it has none."""
        from cell.run.record import drawing

        if (found := self._calibration) is None:
            return None
        return drawing.lens(at, camera, (found.scan if camera == "scan_camera" else found.target).camera)

    def image(self, at: int, camera: str, picture: FrameFile) -> bytes | None:
        """A picture as its file has it; None where there is none."""
        from cell.run.record import small

        png = picture.png(PICTURE_S)
        return None if png is None else small.image(at, camera, png)

    def line(self, at: int, points: NDArray[np.float32]) -> bytes:
        """Points (n, 3) of the base."""
        from cell.run.record import drawing

        return drawing.cloud(at, points)

    def grown(self, at: int, points: NDArray[np.float32], seen: NDArray[np.bool_], lines: Any) -> bytes:
        """The points of these lines, thinned evenly."""
        from cell.run.record import drawing

        there = points[lines][seen[lines]]
        return drawing.cloud(at, there[:: max(1, -(-len(there) // MOST_POINTS))])

    def log_line(self, at: int, record: logging.LogRecord, text: str) -> bytes:
        """A line of the log."""
        from cell.run.record import small

        return small.log_line(at, record, text)
