"""One camera behind Aravis: opened by its address alone, its features read and written, its errors in our words.

Every call that speaks to the camera is made under one lock, because the library's description of it is not safe
between threads. Pictures are taken elsewhere (`acquisition.py`).

What a camera's time stamps are worth: its clock against the host's, and each triggered picture against its trigger.

A camera whose clock can be latched is asked before each acquisition. Of one without a latch a triggered picture tells:
its exposure began after the trigger was sent, and ended before the picture came."""

import ctypes
import ipaddress
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

from drivers.camera.frame_queue import latched
from drivers.camera.genicam.aravis import CONTROL_PRIVILEGE, PRIMARY_APPLICATION_ADDRESS, Aravis, AravisError, Handle
from drivers.clock import Clock, ClockMap, Latch
from drivers.errors import DeviceFault, NotConnectedError
from drivers.interfaces import Frame, Identity

_TIMESTAMP_CONTROL, _TIMESTAMP_HIGH, _TIMESTAMP_LOW = 0x0944, 0x0948, 0x094C
_LATCH = 2
_SFNC_LATCH = ("TimestampLatch", "TimestampLatchValue")
"""Of newer cameras, USB3 Vision's among them: in ns."""


class Place(Protocol):
    """Where a camera is. `control`: another application can hold it; `text` for people."""

    text: str
    control: bool
    absent: str

    def open(self, library: Aravis) -> Handle:
        """The library's device."""


class GigePlace:
    """A GigE Vision camera at an IPv4 address."""

    control = True

    def __init__(self, host: str) -> None:
        self.text = host
        self.absent = (
            "check power and cable, and that the address is in a network of this computer (`ip route get ADDRESS`); a "
            "camera tells its address nowhere but in its maker's tool, nothing is searched for here"
        )

    def open(self, library: Aravis) -> Handle:
        """Speaks to this address alone."""
        return library.open_gige(str(ipaddress.IPv4Address(self.text)))


class UsbPlace:
    """A USB3 Vision camera with a GUID, twelve hexadecimal digits that its maker's viewer shows."""

    control = False

    def __init__(self, guid: str) -> None:
        self.text = f"USB3 {guid}"
        self.guid = guid
        self.absent = (
            "check cable and GUID (its maker's viewer shows it), that this user may use it (Aravis' udev rules), and "
            "that no other program has it open"
        )

    def open(self, library: Aravis) -> Handle:
        """Asks the computer's own USB devices."""
        device: Handle = library.call("arv_uv_device_new_from_guid", self.guid.encode())
        return device


class GenicamDevice:
    """The camera at `place`, with or without control of it.

    Raises `NotConnectedError` when none answers, `DeviceFault` (camera.in_use) when another application holds it and
    `look` is false. With `look` it is not held longer than connecting takes.
    """

    def __init__(self, name: str, place: Place, library: Aravis, *, look: bool) -> None:
        self.name = name
        self.place = place
        self.library = library
        self._lock = threading.RLock()
        self._abandoned = False
        self._device: Handle | None = None
        self.camera: Handle | None = None
        self._holds = not look and place.control
        try:
            self._device = place.open(library)
            self.camera = library.call("arv_camera_new_with_device", self._device)
            if place.control and look and library.plain("arv_gv_device_is_controller", self._device):
                library.call("arv_gv_device_leave_control", self._device)
        except (AravisError, OSError) as error:
            self.close()
            raise NotConnectedError(
                name, f"no camera can be used at {place.text}: {error}. Remedy: {place.absent}"
            ) from error
        if self._holds and not library.plain("arv_gv_device_is_controller", self._device):
            holder = self._holder()
            self.close()
            raise DeviceFault(
                name,
                "camera.in_use",
                f"another application{holder} holds the camera at {place.text}",
                recoverable=False,
                hint="Close it there (a viewer, another cell); a dead one lets go after its heartbeat, often 3 s.",
            )
        frequency = library.call("arv_gv_device_get_timestamp_tick_frequency", self._device) if place.control else 0
        self._seconds_per_tick = 1.0 / frequency if frequency else 0.0
        self.stamps = not place.control or bool(frequency)
        """Whether its pictures carry stamps of a clock of its own; else the library puts the time of their arrival."""

    def close(self) -> None:
        """Let go of the camera; idempotent."""
        with self._lock:
            for thing in (self.camera, self._device):
                if thing is not None:
                    self.library.plain("g_object_unref", thing)
            self.camera = self._device = None

    def abandon(self) -> None:
        """Let go of a camera that does not answer, without waiting for it: the library may take seconds to give up."""
        if not self._abandoned:
            self._abandoned = True
            threading.Thread(target=self.close, name=f"{self.name} given up", daemon=True).start()

    @property
    def open(self) -> bool:
        """False after `close` or `abandon`."""
        return self.camera is not None and not self._abandoned

    @property
    def held(self) -> bool:
        """False once the control of the camera has been lost; the library's heartbeat finds out within seconds."""
        if not self._holds or self._device is None:
            return True
        return bool(self.library.plain("arv_gv_device_is_controller", self._device))

    def call(self, function: str, *arguments: object) -> Any:
        """Ask the library's camera; `DeviceFault` camera.lost when it is silent, camera.refused when it says no."""
        with self._lock:
            if self.camera is None:
                raise NotConnectedError(self.name, "the camera was closed. Open it again")
            with self._words(function, arguments):
                return self.library.call(f"arv_camera_{function}", self.camera, *arguments)

    def plain(self, function: str, *arguments: object) -> None:
        """Set something in the library that the camera is not asked about."""
        with self._lock:
            self.library.plain(f"arv_camera_{function}", self.camera, *arguments)

    def has(self, feature: str) -> bool:
        """Whether the camera describes this feature and it can be used now."""
        return bool(self.call("is_feature_available", feature.encode()))

    def text(self, feature: str) -> str:
        """A feature's text; empty where there is none."""
        if not self.has(feature):
            return ""
        return (self.call("get_string", feature.encode()) or b"").decode(errors="replace")

    def bounds(self, what: str) -> tuple[float, float]:
        """Least and largest value of "exposure_time", "gain" or "frame_rate", in Aravis' units."""
        low, high = ctypes.c_double(), ctypes.c_double()
        self.call(f"get_{what}_bounds", ctypes.byref(low), ctypes.byref(high))
        return low.value, high.value

    def identity(self) -> Identity:
        """Who the camera says it is."""
        words = [(self.call(f) or b"").decode(errors="replace").strip() for f in ("get_vendor_name", "get_model_name")]
        serial = (self.call("get_device_serial_number") or b"").decode(errors="replace")
        firmware = self.text("DeviceFirmwareVersion") or self.text("DeviceVersion")
        return Identity(" ".join(word for word in words if word), serial, firmware, self.place.text)

    def ping(self) -> None:
        """One register read on the wire."""
        with self._lock:
            if self.camera is None:
                raise NotConnectedError(self.name, "the camera was closed. Open it again")
            with self._words("ping", ()):
                if self.place.control:
                    self._register(CONTROL_PRIVILEGE)
                else:
                    self.library.call("arv_camera_get_payload", self.camera)

    def latch(self, clock: Clock) -> Latch | None:
        """The device's clock, read between two host times; None where the camera has no such latch."""
        with self._lock, self._words("latch", ()):
            if self._seconds_per_tick:
                before = clock.now()
                self.library.call("arv_device_write_register", self._device, _TIMESTAMP_CONTROL, _LATCH)
                after = clock.now()
                ticks = (self._register(_TIMESTAMP_HIGH) << 32) | self._register(_TIMESTAMP_LOW)
                return Latch(before, ticks * self._seconds_per_tick, after) if ticks else None
            if not all(self.has(feature) for feature in _SFNC_LATCH):
                return None
            command, value = (feature.encode() for feature in _SFNC_LATCH)
            before = clock.now()
            self.library.call("arv_camera_execute_command", self.camera, command)
            after = clock.now()
            return Latch(before, 1e-9 * self.library.call("arv_camera_get_integer", self.camera, value), after)

    def _register(self, address: int) -> int:
        value = ctypes.c_uint32()
        self.library.call("arv_device_read_register", self._device, address, ctypes.byref(value))
        return value.value

    def _was_released(self, error: AravisError) -> bool:
        """Whether the camera denied something because it has forgotten who controls it, as after a loss of power."""
        if not self._holds or error.code != AravisError.ACCESS_DENIED:
            return False
        with suppress(AravisError):
            return self._register(CONTROL_PRIVILEGE) == 0
        return True

    def _holder(self) -> str:
        # The register is younger than the protocol; a camera without it answers with an error or with zero.
        with suppress(AravisError):
            if address := self._register(PRIMARY_APPLICATION_ADDRESS):
                return f" on {ipaddress.IPv4Address(address)}"
        return ""

    @contextmanager
    def _words(self, function: str, arguments: tuple[object, ...]) -> Iterator[None]:
        try:
            yield
        except AravisError as error:
            asked = " ".join([function, *(a.decode() if isinstance(a, bytes) else f"{a}" for a in arguments)])
            if error.code in AravisError.SILENT or not self.held or self._was_released(error):
                raise self.lost(f"{error} at {asked!r}") from error
            raise DeviceFault(
                self.name,
                "camera.refused",
                f"the camera refused {asked!r}: {error}",
                recoverable=True,
                hint="Correct what it names (`arv-tool-0.8 -a ADDRESS control` shows what it has); where access is "
                "denied, see that no other application has taken the camera.",
            ) from error

    def lost(self, reason: str) -> DeviceFault:
        """The fault to raise when the camera is silent or was taken away."""
        return DeviceFault(
            self.name,
            "camera.lost",
            f"camera lost: {reason}",
            recoverable=True,
            hint=f"Check power and cable of the camera at {self.place.text}, and that no other application has taken "
            "it; the next picture that is asked for connects anew.",
        )


_SLACK_S = 0.002
"""By how much a time stamp may leave the interval of its trigger beyond what the clocks are known to."""


class StampClock:
    """The stamps of the camera `name` since it was connected."""

    def __init__(self, name: str, clock: Clock) -> None:
        self._name = name
        self._clock = clock
        self._map: ClockMap | None = None
        self._latched = False

    @property
    def bound(self) -> float:
        """Largest error in s of a host time; unlimited while nothing has told of the camera's clock."""
        return math.inf if self._map is None else self._map.bound_at(self._clock.now())

    @property
    def slack(self) -> float:
        """By how much, in s, a stamp may seem too early or too late."""
        return _SLACK_S + (0.0 if self._map is None else self._map.uncertainty)

    def compare(self, device: GenicamDevice) -> None:
        """Latch the camera's clock, as often as it takes to get a short round trip; nothing if it has no latch."""
        if latches := latched(self._clock, partial(device.latch, self._clock)):
            self._latched = True
            self._add(latches)

    def host_time(self, device_time: float, *, latest: float) -> float:
        """Host time in s of a stamp; `latest`, at which it was at the latest, while the clock is not known."""
        return latest if self._map is None else self._map.host_time(device_time)

    def judged(self, frame: Frame, called: float) -> Frame:
        """The frame of a trigger that was sent at `called`, s; `DeviceFault` (camera.clock) when its stamp is none."""
        last = frame.received - frame.exposure
        if self._map is not None and called - frame.host_time > self.slack:
            raise self.too_early(frame, called)
        if (wrong := self.impossible(frame)) is not None:
            raise wrong
        if self._latched or not frame.device_time or last <= called:
            return frame
        self._add([Latch(called, frame.device_time, last)])
        return replace(frame, host_time=self.host_time(frame.device_time, latest=last))

    def too_early(self, frame: Frame, called: float) -> DeviceFault:
        """The fault (camera.clock) of a picture whose exposure began before it was asked for at `called`, s."""
        return self._wrong("before it was asked for", called - frame.host_time, self.slack)

    def impossible(self, frame: Frame) -> DeviceFault | None:
        """The fault (camera.clock) of a picture that was here before its exposure can have ended, as its stamp says."""
        if self._map is None:
            return None
        slack = _SLACK_S + self._map.bound_at(frame.received)
        late = frame.host_time - (frame.received - frame.exposure)
        return None if late <= slack else self._wrong("too late to be here already", late, slack)

    def _add(self, latches: list[Latch]) -> None:
        if self._map is None:
            self._map = ClockMap()
        self._map.add(latches)

    def _wrong(self, which: str, off: float, allowed: float) -> DeviceFault:
        return DeviceFault(
            self._name,
            "camera.clock",
            f"the time stamp of a picture says that its exposure began {1e3 * off:.1f} ms {which} "
            f"(allowed: {1e3 * allowed:.1f} ms)",
            recoverable=False,
            hint="Its stamps are none of the start of the exposure, or its clock was set meanwhile or does not run at "
            "the rate that it tells. Look into its maker's manual; such a camera cannot measure a sweep.",
        )
