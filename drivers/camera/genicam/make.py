"""The makes `gige` and `usb3` of cameras: their records in `cell.toml`, and how they are connected.

docs/how-to/cameras.md tells what each key does, and what of it has run on what.
"""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import AfterValidator, StringConstraints

from drivers.common.units import number, quantity, whole
from drivers.make import OPTICS, OPTICS_SINCE, AnyMake, CameraConfig, Make, Surroundings, with_endpoint

if TYPE_CHECKING:
    from drivers.camera.genicam.camera import GenicamCamera

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


class GenicamConfig(CameraConfig):
    """What is set on a GenICam camera. `offset`: first column and row that are read; `gain` in dB (None: as it is)."""

    pixel_format: PixelFormat = "Mono8"
    offset: tuple[Corner, Corner] = (0, 0)
    gain: Gain | None = None
    trigger: Literal["software", "free", "line"] = "software"
    trigger_line: Annotated[str, StringConstraints(pattern=r"\w{1,40}")] = "Line1"
    trigger_edge: Literal["rising", "falling"] = "rising"

    @property
    def paced(self) -> bool:
        """Whether the camera keeps the frame rate by itself."""
        return self.trigger != "line"


class GigeCameraConfig(GenicamConfig):
    """A GigE Vision camera at an IPv4 address, and how its packets come over the network.

    `packet_size` None: the largest that passes. `resend`: missing packets are asked for again; a picture is given up
    `retention` after its last packet.
    """

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


def _gige(name: str, config: GigeCameraConfig, around: Surroundings) -> GenicamCamera:
    from drivers.camera.genicam.camera import GenicamCamera
    from drivers.camera.genicam.device import GigePlace

    return GenicamCamera(name, GigePlace(config.address), config, clock=around.clock, look=around.look)


def _usb3(name: str, config: Usb3CameraConfig, around: Surroundings) -> GenicamCamera:
    from drivers.camera.genicam.camera import GenicamCamera
    from drivers.camera.genicam.device import UsbPlace

    return GenicamCamera(name, UsbPlace(config.guid), config, clock=around.clock, look=around.look)


def _without_aravis() -> str:
    from drivers.camera.genicam.aravis import AravisMissing, load

    try:
        load()
    except AravisMissing as problem:
        return str(problem)
    return ""


_REGION = OPTICS | {"offset", "pixel_format"}

GIGE: AnyMake = Make(
    "camera", "gige", GigeCameraConfig, _gige, _REGION, calibrated_since=OPTICS_SINCE,
    simulated=with_endpoint("address"), missing=_without_aravis,
)  # fmt: skip
USB3: AnyMake = Make(
    "camera", "usb3", Usb3CameraConfig, _usb3, _REGION, calibrated_since=OPTICS_SINCE, missing=_without_aravis
)
