"""A camera on GigE Vision or USB3 Vision: connected, set as its table says with each value read back, and its frames.

Its time stamps are mapped to the host's clock through latches of its clock before each acquisition; where it has no
latch, through triggered pictures, which began after the trigger was sent and ended before they came. Each triggered
picture is also held against that interval, every other one against its end: a camera whose stamps do not lie in it is
refused. Nothing of this has run on a camera of any maker yet; docs/how-to/cameras.md says with what it was tested.
"""

import ctypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from drivers.camera.frame_queue import QUEUE_BYTES, FrameQueue, alone, capacity, check_fits, frame_patience
from drivers.camera.genicam.acquisition import FORMATS, AcquiredPicture, Acquisition
from drivers.camera.genicam.aravis import AravisMissing, load
from drivers.camera.genicam.device import GenicamDevice, Place, StampClock
from drivers.camera.genicam.make import GenicamConfig, GigeCameraConfig
from drivers.clock import Clock
from drivers.errors import (
    DeviceFault,
    InterlockError,
    LimitError,
    NotConnectedError,
    check_positive,
    check_range,
    in_the_end,
    shown,
)
from drivers.interfaces import Frame, Identity, LinkStatistics

_LONGEST_GAP_S = 2.0
_TRIES = 3
_PACKETS_LOST = "camera.packets_lost"


class GenicamCamera:
    """The camera at `place`, set as `record` says; `look`: only looked at, nothing is set and no picture can be taken.

    Raises `NotConnectedError` when the library or the camera is missing, `DeviceFault` when another application holds
    the camera or it refuses a setting, `LimitError` when a setting is outside its range.
    """

    def __init__(self, name: str, place: Place, record: GenicamConfig, *, clock: Clock, look: bool = False) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self.shape = (record.height, record.width)
        self._place = place
        self._record = record
        self._clock = clock
        self._look = look
        self._acquiring = threading.Lock()
        self._queue: FrameQueue | None = None
        self._acquisition: Acquisition | None = None
        self._wish: Wish | None = None
        self._serial: str | None = None
        self._count = 0
        self._closed = False
        self._connect()

    def identity(self) -> Identity:
        """Ask the camera who it is."""
        return self._ready().identity()

    @property
    def time_bound(self) -> float:
        """Largest error in s of a frame's host time; unlimited while nothing tells of the camera's clock."""
        return self._stamps.bound

    def ping(self) -> float:
        """One register read; returns the round trip in wall seconds."""
        device = self._ready()
        before = self._clock.now()
        device.ping()
        seconds = self._clock.wall(self._clock.now() - before)
        self.statistics.add_round_trip(seconds)
        return seconds

    def configure(self, exposure: float, frame_rate: float) -> None:
        """Set exposure in s and frame rate in Hz.

        Raises `LimitError` outside the camera's range or when the exposure does not fit into a frame, `InterlockError`
        while frames are being acquired, `DeviceFault` when the camera takes other values.
        """
        with self._exclusive() as device:
            self._wish = set_timing(device, Wish(exposure, frame_rate), paced=self._record.paced)

    def grab(self, timeout: float = 2.0) -> Frame:
        """One frame whose exposure began after the call: never a buffered one.

        Refused with `InterlockError` while a stream is open. Raises `DeadlineError` when no frame comes in `timeout` s,
        `DeviceFault` when the camera is lost (camera.lost), packets are missing of three pictures in turn
        (camera.packets_lost) or its time stamp is none of this exposure (camera.clock).
        """
        with self._exclusive() as device:
            self._stamps.compare(device)
            triggered = set_trigger(device, self._record, self._timing(device), photograph=True)
            tried = 0
            while True:
                try:
                    return self._photograph(device, timeout, triggered=triggered)
                except DeviceFault as fault:
                    tried += 1
                    if fault.code != _PACKETS_LOST or tried == _TRIES:
                        raise

    @contextmanager
    def stream(self) -> Iterator[FrameQueue]:
        """Frames at the configured rate, or at the pulses of the trigger's line, while the context is open. One at a
        time. Frames that nobody takes are kept up to 64 MB; later ones are dropped and counted as lost."""
        with self._exclusive() as device:
            self._stamps.compare(device)
            set_trigger(device, self._record, self._timing(device), photograph=False)
            with self._acquire(device, capacity(self.shape), whole=False) as frames:
                yield frames

    def stop(self) -> None:
        """End every acquisition; whoever waits for a frame gets `Aborted`."""
        if (queue := self._queue) is not None:
            queue.close(aborted=True)
        if (acquisition := self._acquisition) is not None:
            acquisition.stop()

    def close(self) -> None:
        """End acquisition and connection; idempotent."""
        self._closed = True
        try:
            self.stop()
        finally:
            if self._device.open:
                self._device.close()

    def _connect(self) -> None:
        device, self._serial = connect(
            self.name, self._place, self._record, self._wish, look=self._look, serial=self._serial
        )
        self._device, self._stamps = device, StampClock(self.name, self._clock)
        if not self._look:
            try:
                self._stamps.compare(device)
            except BaseException:
                device.close()
                raise

    def _ready(self) -> GenicamDevice:
        """The camera, connected anew if it was lost."""
        if self._closed:
            raise NotConnectedError(self.name, "the camera was closed. Open it again")
        if not self._device.open or not self._device.held:
            if self._acquisition is not None:
                raise self._device.lost("its link is down while pictures are being taken")
            self._device.abandon()
            self._connect()
            self.statistics.count("link_lost")
        return self._device

    @contextmanager
    def _exclusive(self) -> Iterator[GenicamDevice]:
        if self._look:
            raise InterlockError(self.name, "the camera is only looked at. Open it to use it")
        with alone(self.name, self._acquiring):
            try:
                yield self._ready()
            except DeviceFault as fault:
                if fault.code == "camera.lost":
                    self._device.abandon()
                raise

    @contextmanager
    def _acquire(self, device: GenicamDevice, most: int, *, whole: bool) -> Iterator[FrameQueue]:
        """Frames while the camera acquires; `whole`: an incomplete picture is a fault, not only a loss."""

        wrong: list[DeviceFault] = []

        def check() -> None:
            if acquisition.failure is not None:
                raise acquisition.failure
            if wrong:
                raise wrong[0]
            if whole and acquisition.incomplete:
                raise self._packets_lost()

        queue = FrameQueue(
            self.name, self._clock, capacity=most,
            longest_gap=_LONGEST_GAP_S + (2.0 / self._wish.frame_rate if self._wish else 0.0), check=check,
            statistics=self.statistics,
        )  # fmt: skip
        base = self._count

        def take(picture: AcquiredPicture) -> None:
            self._count = base + picture.count
            frame = self._frame(picture, self._count)
            if (fault := self._stamps.impossible(frame)) is not None:
                wrong.append(fault)
                queue.wake()
            else:
                queue.put(frame)

        network = self._record if isinstance(self._record, GigeCameraConfig) else None
        buffers = max(4, min(64, QUEUE_BYTES // max(1, self.shape[0] * self.shape[1])))
        acquisition = Acquisition(device, network, buffers, take=take, failed=queue.wake, statistics=self.statistics)
        self._queue, self._acquisition = queue, acquisition
        try:
            with in_the_end(acquisition.stop):
                acquisition.start()
                yield queue
        finally:
            self._queue = self._acquisition = None
            queue.close()

    def _photograph(self, device: GenicamDevice, timeout: float, *, triggered: bool) -> Frame:
        with self._acquire(device, 4, whole=True) as frames:
            called = self._clock.now()
            until = called + self._clock.rate * frame_patience(self._clock, timeout)
            if triggered:
                device.call("software_trigger")
            while True:
                frame = frames.next(timeout)
                if triggered:
                    return self._stamps.judged(frame, called)
                if frame.host_time >= called - self._stamps.slack:
                    return frame
                self.statistics.count("stale_frames")
                if self._clock.now() > until:
                    raise self._stamps.too_early(frame, called)

    def _frame(self, picture: AcquiredPicture, count: int) -> Frame:
        received = self._clock.now()
        if picture.image.shape != self.shape:
            height, width = picture.image.shape
            raise ValueError(f"a picture has {width}x{height} pixels, set were {self.shape[1]}x{self.shape[0]}")
        assert self._wish is not None
        device_time = picture.device_ns * 1e-9 if self._device.stamps else 0.0
        host_time = self._stamps.host_time(device_time, latest=received - self._wish.exposure)
        return Frame(picture.image, count, self._wish.exposure, device_time, host_time=host_time, received=received)

    def _timing(self, device: GenicamDevice) -> "Wish":
        """What is set; before the first `configure` whatever the camera has."""
        if self._wish is None:
            self._wish = set_timing(device, None, paced=self._record.paced)
        return self._wish

    def _packets_lost(self) -> DeviceFault:
        return DeviceFault(
            self.name,
            _PACKETS_LOST,
            "packets of a picture were lost on the way and did not come again",
            recoverable=True,
            hint="Use packets that the network carries (packet_size, jumbo frames), pause between them (packet_delay), "
            "keep resend on, and give the camera a network port of its own.",
        )


_TOLERANCE = 0.01
_OFF = 0


@dataclass(frozen=True)
class Wish:
    """Exposure in s and frame rate in Hz."""

    exposure: float
    frame_rate: float


def set_image(device: GenicamDevice, record: GenicamConfig) -> None:
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
    for feature, value in (("Width", record.width), ("Height", record.height)):
        _set_integer(device, feature, value)
    for feature, value in zip(("OffsetX", "OffsetY"), record.offset, strict=True):
        if value or device.has(feature):
            _set_integer(device, feature, value)
    _set_text(device, "PixelFormat", record.pixel_format, f"known here: {', '.join(FORMATS)}")
    if (gain := record.gain) is not None:
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
    check_fits(device.name, wish.exposure, wish.frame_rate)
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


def set_trigger(device: GenicamDevice, record: GenicamConfig, wish: Wish, *, photograph: bool) -> bool:
    """Set what begins the exposures of a photograph, or of a stream; whether a command has to trigger them.

    "software": a photograph is triggered by a command, a stream runs free. "free": both run free. "line": both wait for
    pulses on a line, and the frame rate is theirs.

    Raises `DeviceFault` when the camera does not offer it.
    """
    if record.trigger == "software" and photograph:
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
    if record.trigger == "line":
        device.call("set_trigger", record.trigger_line.encode())
        edge = f"{record.trigger_edge.capitalize()}Edge"
        _set_text(device, "TriggerActivation", edge, "usual: RisingEdge, FallingEdge")
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


def connect(
    name: str, place: Place, record: GenicamConfig, wish: Wish | None, *, look: bool, serial: str | None
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
            set_image(device, record)
            if isinstance(record, GigeCameraConfig):
                _set_packets(device, record)
            if wish is not None:
                set_timing(device, wish, paced=record.paced)
    except BaseException:
        device.close()
        raise
    return device, found


def _set_packets(device: GenicamDevice, network: GigeCameraConfig) -> None:
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
