"""The makes `stream`, `v4l2` and `folder` of cameras: their records in `cell.toml`, and how they are connected."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import AfterValidator, StringConstraints

from drivers.common.addresses import Endpoint
from drivers.common.units import number
from drivers.make import OPTICS, OPTICS_SINCE, AnyMake, CameraConfig, Make, Surroundings, with_endpoint

if TYPE_CHECKING:
    from drivers.camera.folder import RecordedCamera
    from drivers.camera.stream import StreamCamera
    from drivers.camera.v4l2 import V4l2Camera


def _path(text: str) -> str:
    if not text.strip() or "\0" in text:
        raise ValueError(f'"{text}" is no path')
    return text


class StreamCameraConfig(CameraConfig):
    """A camera on the frame stream protocol."""

    driver: Literal["stream"] = "stream"
    address: Annotated[str, Endpoint]


class V4l2CameraConfig(CameraConfig):
    """A camera behind a device file of Linux."""

    ADDRESS: ClassVar[str] = "device"

    driver: Literal["v4l2"] = "v4l2"
    device: Annotated[str, StringConstraints(pattern=r"/dev/[\w./-]+")]
    pixel_format: Literal["GREY", "YUYV", "MJPG"] = "YUYV"
    gain: Annotated[float, number(0, 100_000)] | None = None


class FolderCameraConfig(CameraConfig):
    """Recorded pictures with their times in `times.csv`, in a folder seen from where the program is started."""

    ADDRESS: ClassVar[str] = "folder"

    driver: Literal["folder"] = "folder"
    folder: Annotated[str, AfterValidator(_path)]


def _stream(name: str, config: StreamCameraConfig, around: Surroundings) -> StreamCamera:
    from drivers.camera.stream import StreamCamera

    return StreamCamera(name, config.address, shape=(config.height, config.width), clock=around.clock)


def _v4l2(name: str, config: V4l2CameraConfig, around: Surroundings) -> V4l2Camera:
    from drivers.camera.v4l2 import V4l2Camera

    return V4l2Camera(
        name, config.device, clock=around.clock, shape=(config.height, config.width), fourcc=config.pixel_format,
        gain=config.gain, look=around.look,
    )  # fmt: skip


def _folder(name: str, config: FolderCameraConfig, around: Surroundings) -> RecordedCamera:
    from drivers.camera.folder import RecordedCamera

    return RecordedCamera(name, Path(config.folder), clock=around.clock, shape=(config.height, config.width))


STREAM: AnyMake = Make(
    "camera", "stream", StreamCameraConfig, _stream, OPTICS, calibrated_since=OPTICS_SINCE,
    simulated=with_endpoint("address"),
)  # fmt: skip
V4L2: AnyMake = Make(
    "camera", "v4l2", V4l2CameraConfig, _v4l2, OPTICS | {"pixel_format"}, calibrated_since=OPTICS_SINCE
)
FOLDER: AnyMake = Make(
    "camera", "folder", FolderCameraConfig, _folder, OPTICS, calibrated_since=OPTICS_SINCE, replays=True
)
