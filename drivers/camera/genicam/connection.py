"""How a camera is connected: opened, recognised, and set as its table says. Done anew when a lost one is back.

What is set on a GenICam camera: region, pixel format, gain, exposure, frame rate, trigger; each one read back."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field
from typing import Literal

from drivers.camera.genicam.acquisition import FORMATS, Network
from drivers.camera.genicam.aravis import AravisMissing, load
from drivers.camera.genicam.device import GenicamDevice, Place
from drivers.errors import CellError, DeviceFault, LimitError, NotConnectedError, check_positive, check_range, shown

_TOLERANCE = 0.01
_OFF = 0


@dataclass(frozen=True)
class Region:
    """The part of the sensor that is read, in pixels; `left` and `top` count from the sensor's first pixel."""

    width: int
    height: int
    left: int = 0
    top: int = 0


@dataclass(frozen=True)
class ExposureTrigger:
    """What begins an exposure.

    "software": a photograph is triggered by a command, a stream runs free. "free": both run free. "line": both wait for
    pulses on `line`, and the frame rate is theirs.
    """

    kind: Literal["software", "free", "line"] = "software"
    line: str = "Line1"
    activation: str = "RisingEdge"

    @property
    def paced(self) -> bool:
        """Whether the camera keeps the frame rate by itself."""
        return self.kind != "line"


@dataclass(frozen=True)
class Wish:
    """Exposure in s and frame rate in Hz."""

    exposure: float
    frame_rate: float


def set_image(device: GenicamDevice, region: Region, pixel_format: str, gain: float | None) -> None:
    """Set what does not change while the cell is open. Raises `LimitError` or `DeviceFault` (camera.setting)."""
    device.call("set_acquisition_mode", _OFF)  # continuous
    if device.call("is_exposure_auto_available"):
        device.call("set_exposure_time_auto", _OFF)
    if device.call("is_gain_auto_available"):
        device.call("set_gain_auto", _OFF)
    # A smaller region has room for its offset only once it is small, a larger one only once the offset is gone.
    for feature in ("OffsetX", "OffsetY"):
        if device.has(feature):
            _set_integer(device, feature, 0)
    for feature, value in (("Width", region.width), ("Height", region.height)):
        _set_integer(device, feature, value)
    for feature, value in (("OffsetX", region.left), ("OffsetY", region.top)):
        if value or device.has(feature):
            _set_integer(device, feature, value)
    _set_text(device, "PixelFormat", pixel_format, f"known here: {', '.join(FORMATS)}")
    if gain is not None:
        low, high = device.bounds("gain")
        check_range(device.name, "gain", gain, low=low, high=high, unit="")
        device.call("set_gain", gain)
        _check_taken(device, "gain", gain, device.call("get_gain"), "")


def set_timing(device: GenicamDevice, wish: Wish | None, *, paced: bool) -> Wish:
    """Set exposure and, where the camera keeps it by itself (`paced`), frame rate; without a wish they are read.

    Raises `LimitError` outside the ranges or when the exposure does not fit into a frame, before anything is set;
    `DeviceFault` (camera.setting) when the camera takes other values.
    """
    rated = paced and bool(device.call("is_frame_rate_available"))
    if wish is None:
        return Wish(device.call("get_exposure_time") * 1e-6, device.call("get_frame_rate") if rated else 1.0)
    low, high = device.bounds("exposure_time")
    check_range(device.name, "exposure", wish.exposure, low=low * 1e-6, high=high * 1e-6, unit="s")
    if rated:
        check_positive(device.name, "frame rate", wish.frame_rate, device.bounds("frame_rate")[1], "Hz")
    else:
        check_positive(device.name, "frame rate", wish.frame_rate, 10_000.0, "Hz")
    if wish.exposure * wish.frame_rate > 1.0:
        raise LimitError(
            device.name,
            f"exposure {shown(wish.exposure, 's')} does not fit into a frame at {wish.frame_rate:g} Hz; nothing was "
            f"sent. Choose at most {shown(1.0 / wish.frame_rate, 's')}, or at most {1.0 / wish.exposure:g} Hz",
        )
    # Either may limit the other on the way: what gets smaller goes first.
    shorter = wish.exposure * 1e6 <= device.call("get_exposure_time")
    if not shorter and rated:
        device.call("set_frame_rate", wish.frame_rate)
    device.call("set_exposure_time", wish.exposure * 1e6)
    if rated:
        device.call("set_frame_rate", wish.frame_rate)
        _check_taken(device, "frame rate", wish.frame_rate, device.call("get_frame_rate"), "Hz")
    taken = device.call("get_exposure_time") * 1e-6
    _check_taken(device, "exposure", wish.exposure, taken, "s")
    return Wish(taken, wish.frame_rate)


def set_trigger(device: GenicamDevice, trigger: ExposureTrigger, wish: Wish, *, photograph: bool) -> bool:
    """Set what begins the exposures of a photograph, or of a stream; whether a command has to trigger them.

    Raises `DeviceFault` when the camera does not offer it.
    """
    if trigger.kind == "software" and photograph:
        if not device.call("is_software_trigger_supported"):
            raise DeviceFault(
                device.name,
                "camera.setting",
                "the camera has no software trigger",
                recoverable=False,
                hint='Write trigger = "free" in its table: photographs are then taken from a free run.',
            )
        device.call("set_trigger", b"Software")
        return True
    if trigger.kind == "line":
        device.call("set_trigger", trigger.line.encode())
        _set_text(device, "TriggerActivation", trigger.activation, "usual: RisingEdge, FallingEdge")
        return False
    device.call("clear_triggers")
    if device.call("is_frame_rate_available"):
        # Triggers switch the rate off.
        device.call("set_frame_rate", wish.frame_rate)
    return False


def _set_integer(device: GenicamDevice, feature: str, value: int) -> None:
    name = feature.encode()
    if device.call("get_integer", name) == value:
        return
    low, high = ctypes.c_int64(), ctypes.c_int64()
    device.call("get_integer_bounds", name, ctypes.byref(low), ctypes.byref(high))
    step = max(1, device.call("get_integer_increment", name))
    if not low.value <= value <= high.value or (value - low.value) % step:
        raise LimitError(
            device.name,
            f"{feature} {value} is none that the camera has (allowed: {low.value} to {high.value} in steps of {step} "
            "pixels). Correct width, height and offset in its table",
        )
    device.call("set_integer", name, value)
    _check_taken(device, feature, value, device.call("get_integer", name), "pixels")


def _set_text(device: GenicamDevice, feature: str, value: str, known: str) -> None:
    if device.text(feature) == value:
        return
    try:
        device.call("set_string", feature.encode(), value.encode())
    except DeviceFault as fault:
        if fault.code != "camera.refused":
            raise
        raise DeviceFault(
            device.name,
            "camera.setting",
            f"the camera has no {feature} {value}, it stays {device.text(feature)}",
            recoverable=False,
            hint=f"Choose one that it has ({known}).",
        ) from fault
    if (taken := device.text(feature)) != value:
        raise DeviceFault(
            device.name,
            "camera.setting",
            f"the camera took {feature} {taken} instead of {value}",
            recoverable=False,
            hint=f"Choose one that it has ({known}).",
        )


def _check_taken(device: GenicamDevice, what: str, asked: float, taken: float, unit: str) -> None:
    if abs(taken - asked) > _TOLERANCE * abs(asked):
        raise DeviceFault(
            device.name,
            "camera.setting",
            f"the camera took {what} {shown(taken, unit)} instead of {shown(asked, unit)}",
            recoverable=False,
            hint="Choose a value that the camera supports.",
        )


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
