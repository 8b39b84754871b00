"""How a camera is connected: opened, recognised, and set as its table says. Done anew when a lost one is back."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivers.camera.genicam.acquisition import Network
from drivers.camera.genicam.aravis import AravisMissing, load
from drivers.camera.genicam.device import GenicamDevice, Place
from drivers.camera.genicam.settings import ExposureTrigger, Region, Wish, set_image, set_timing
from drivers.errors import CellError, DeviceFault, NotConnectedError

_NO_RAW_SOCKETS = 1
_NEVER = 0


@dataclass(frozen=True)
class GenicamSetup:
    """How the camera is to be set: the picture's format and region, gain in dB (None: as it is), trigger, network."""

    region: Region
    pixel_format: str = "Mono8"
    gain: float | None = None
    trigger: ExposureTrigger = field(default_factory=ExposureTrigger)
    network: Network = field(default_factory=Network)


def connect(
    name: str, place: Place, setup: GenicamSetup, wish: Wish | None, *, look: bool, serial: str | None
) -> tuple[GenicamDevice, str]:
    """The camera at `place`, set up unless it is only looked at, and its serial number.

    `serial` is the number that it had before, None at first; `wish` its timing, None for what it has. Raises
    `NotConnectedError`, `DeviceFault` and `LimitError` as `GenicamCamera` says.
    """
    try:
        library = load()
    except AravisMissing as missing:
        raise NotConnectedError(name, str(missing)) from missing
    device = GenicamDevice(name, place, library, look=look)
    try:
        found = device.identity().serial
        if serial not in (None, found):
            raise NotConnectedError(
                name,
                f"the camera at {place.text} has serial number {found} now, it was {serial}. "
                "Open the cell again, with the calibration of this camera",
            )
        if not look:
            set_image(device, setup.region, setup.pixel_format, setup.gain)
            if place.control:
                _set_packets(device, setup.network)
            if wish is not None:
                set_timing(device, wish, paced=setup.trigger.paced)
    except CellError:
        device.close()
        raise
    return device, found


def _set_packets(device: GenicamDevice, network: Network) -> None:
    # Raw sockets need rights that a cell should not have; the size is settled here, once, and not behind our back.
    device.plain("gv_set_stream_options", _NO_RAW_SOCKETS)
    device.plain("gv_set_packet_size_adjustment", _NEVER)
    if network.packet_size is None:
        device.call("gv_auto_packet_size")
    else:
        device.call("gv_set_packet_size", network.packet_size)
        taken = device.call("gv_get_packet_size")
        if taken != network.packet_size:
            raise DeviceFault(
                device.name,
                "camera.setting",
                f"the camera took packets of {taken} bytes instead of {network.packet_size}",
                recoverable=False,
                hint="Choose what it and the network carry, such as 1500, or leave packet_size out.",
            )
    if network.packet_delay:
        device.call("gv_set_packet_delay", round(network.packet_delay * 1e9))
