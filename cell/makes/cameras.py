"""Makes of cameras that can be bought, and recordings: their records in `cell.toml` and how each is connected.

docs/how-to/cameras.md tells what each key does, and what of it has run on what.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import AfterValidator, StringConstraints

from cell.base.units import number, quantity, whole
from cell.makes.make import AnyMake, CameraConfig, Make, Surroundings

if TYPE_CHECKING:
    from drivers.camera.folder import RecordedCamera
    from drivers.camera.genicam.camera import GenicamCamera
    from drivers.camera.genicam.device import Place
    from drivers.camera.v4l2 import V4l2Camera

OPTICS = frozenset(("width", "height", "pixel", "focal_length", "flange_from_camera"))
"""On these a calibration depends, whatever the camera's make."""

PixelFormat = Literal[
    "Mono8", "Mono10", "Mono10Packed", "Mono10p", "Mono12", "Mono12Packed", "Mono12p", "Mono16",
    "BayerGR8", "BayerRG8", "BayerGB8", "BayerBG8", "RGB8", "BGR8",
]  # fmt: skip
Corner = Annotated[int, whole(0, 8192)]
Gain = Annotated[float, number(-30, 60)]


def _ipv4(text: str) -> str:
    try:
        address = ipaddress.IPv4Address(text)
    except ValueError as error:
        raise ValueError(f'"{text}" is no IPv4 address, such as "192.168.1.20"; a GigE camera has no name') from error
    if address.is_unspecified or address.is_multicast or address == ipaddress.IPv4Address("255.255.255.255"):
        raise ValueError(f'"{text}" is not the address of one camera; write its own, such as "192.168.1.20"')
    return text


def _path(text: str) -> str:
    if not text.strip() or "\0" in text:
        raise ValueError(f'"{text}" is no path')
    return text


class GenicamConfig(CameraConfig):
    """What is set on a GenICam camera. `offset`: first column and row that are read; `gain` in dB (None: as it is)."""

    pixel_format: PixelFormat = "Mono8"
    offset: tuple[Corner, Corner] = (0, 0)
    gain: Gain | None = None
    trigger: Literal["software", "free", "line"] = "software"
    trigger_line: Annotated[str, StringConstraints(pattern=r"\w{1,40}")] = "Line1"
    trigger_edge: Literal["rising", "falling"] = "rising"


class GigeCameraConfig(GenicamConfig):
    """A GigE Vision camera at an IPv4 address, and how its packets come over the network."""

    driver: Literal["gige"] = "gige"
    address: Annotated[str, AfterValidator(_ipv4)]
    packet_size: Annotated[int, whole(576, 16000, meaning=" bytes")] | None = None
    packet_delay: Annotated[float, quantity("us", 0, 10_000)] = 0.0
    resend: bool = True
    packet_timeout: Annotated[float, quantity("ms", 1, 1000)] = 0.02
    retention: Annotated[float, quantity("ms", 10, 10_000)] = 0.5


class Usb3CameraConfig(GenicamConfig):
    """A USB3 Vision camera, by the GUID that it tells the computer."""

    ADDRESS: ClassVar[str] = "guid"

    driver: Literal["usb3"] = "usb3"
    guid: Annotated[str, StringConstraints(pattern=r"[0-9A-Fa-f]{12}")]


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


def _genicam(name: str, config: GenicamConfig, place: Place, around: Surroundings) -> GenicamCamera:
    from drivers.camera.genicam.acquisition import Network
    from drivers.camera.genicam.camera import GenicamCamera
    from drivers.camera.genicam.connection import ExposureTrigger, GenicamSetup, Region

    left, top = config.offset
    network = Network()
    if isinstance(config, GigeCameraConfig):
        network = Network(
            config.packet_size, config.packet_delay, config.resend, config.packet_timeout, config.retention
        )
    setup = GenicamSetup(
        Region(config.width, config.height, left, top),
        config.pixel_format,
        config.gain,
        ExposureTrigger(config.trigger, config.trigger_line, f"{config.trigger_edge.capitalize()}Edge"),
        network,
    )
    return GenicamCamera(name, place, setup, clock=around.clock, look=around.look)


def _gige(name: str, config: GigeCameraConfig, around: Surroundings) -> GenicamCamera:
    from drivers.camera.genicam.device import GigePlace

    return _genicam(name, config, GigePlace(config.address), around)


def _usb3(name: str, config: Usb3CameraConfig, around: Surroundings) -> GenicamCamera:
    from drivers.camera.genicam.device import UsbPlace

    return _genicam(name, config, UsbPlace(config.guid), around)


def _v4l2(name: str, config: V4l2CameraConfig, around: Surroundings) -> V4l2Camera:
    from drivers.camera.v4l2 import V4l2Camera

    return V4l2Camera(
        name, config.device, clock=around.clock, shape=(config.height, config.width), fourcc=config.pixel_format,
        gain=config.gain, look=around.look,
    )  # fmt: skip


def _folder(name: str, config: FolderCameraConfig, around: Surroundings) -> RecordedCamera:
    from drivers.camera.folder import RecordedCamera

    return RecordedCamera(name, Path(config.folder), clock=around.clock, shape=(config.height, config.width))


def _without_aravis() -> str:
    from drivers.camera.genicam.aravis import AravisMissing, load

    try:
        load()
    except AravisMissing as problem:
        return str(problem)
    return ""


def _served(record: GigeCameraConfig, endpoint: Mapping[str, object]) -> GigeCameraConfig:
    return record.model_copy(update={"address": endpoint["address"]})


_REGION = OPTICS | {"offset", "pixel_format"}

GIGE: AnyMake = Make(
    "camera", "gige", GigeCameraConfig, _gige, _REGION, simulated=_served, missing=_without_aravis
)  # fmt: skip
USB3: AnyMake = Make("camera", "usb3", Usb3CameraConfig, _usb3, _REGION, missing=_without_aravis)
V4L2: AnyMake = Make("camera", "v4l2", V4l2CameraConfig, _v4l2, OPTICS | {"pixel_format"})
FOLDER: AnyMake = Make("camera", "folder", FolderCameraConfig, _folder, OPTICS, replays=True)
