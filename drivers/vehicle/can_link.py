"""The CAN bus: sending frames, and a receive thread that never dies unnoticed.

python-can's own notifier thread ends silently on a bus error; this one keeps the reason, and every later use of the
link raises it.
"""

import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import can
import serial

from drivers.errors import ConfigError, DeviceFault, NotConnectedError
from drivers.interfaces import LinkStatistics
from drivers.last_words import LastWords, descriptor_of
from drivers.vehicle.protocol_bufsocket import SCHEME

if "drivers.vehicle" not in serial.protocol_handler_packages:
    serial.protocol_handler_packages.append("drivers.vehicle")

RECEIVE_TIMEOUT_S = 0.1
SEND_TIMEOUT_S = 0.5
MOST_REFUSED = 5
"""So many frames in a row may an adapter refuse: after it is opened it may refuse a command or two."""
REFUSED = "refused"
"""Counts the frames that an adapter has refused, where it says so."""
_BELL, _TAKEN = "\a", ("\r", "z\r", "Z\r")
"""How an slcan adapter answers what it refuses, and a frame that it has taken."""


def data_frame(identifier: int, data: bytes) -> can.Message:
    """A frame with a short identifier."""
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


class CanLink:
    """An open CAN bus; `receive` is called in the receive thread with each frame, error frames excepted, and `idle`
    with the seconds on the wall for which it has waited before each frame, whoever sent that.

    `alone` says, in the text of a failed bus, what the vehicle then does by itself. A frame that `receive` refuses with
    ValueError or IndexError is counted as malformed. Raises `NotConnectedError` when the bus cannot be opened,
    `ConfigError` when python-can has no such interface.
    """

    def __init__(
        self, name: str, interface: str, channel: str, *, bitrate: int,
        receive: Callable[[can.Message], None], idle: Callable[[float], None], statistics: LinkStatistics, alone: str,
    ) -> None:  # fmt: skip
        self._name = name
        self._address = f"{interface}:{channel}"
        self._alone = alone
        self._receive = receive
        self._idle = idle
        self._statistics = statistics
        self._sending = threading.Lock()
        self._closing = threading.Event()
        self._failure: str | None = None
        self._heard: list[tuple[float, can.Message]] | None = None
        self._refused = 0
        """Frames in a row that the adapter has refused, where it says so."""
        self._bus = self._open(interface, channel, bitrate)
        self._interface = interface
        self._last_words: LastWords | None = None
        self._thread = threading.Thread(target=self._run, name=f"{name} receiver", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """True while the bus works and its receive thread runs."""
        return self._failure is None and self._thread.is_alive()

    def check(self) -> None:
        """Raise `NotConnectedError` after `close`, `DeviceFault` (vehicle.link_lost) when the bus has failed. A bus
        that failed says so also once it was closed, so that one that cannot be opened again yet is tried later."""
        if self._closing.is_set() and self._failure is None:
            raise NotConnectedError(self._name, "the vehicle was closed. Open it again")
        if not self.alive:
            raise DeviceFault(
                self._name,
                "vehicle.link_lost",
                f"the CAN bus at {self._address} failed: {self._failure or 'the receive thread has ended'}; "
                f"{self._alone}",
                recoverable=True,
                hint="Check the adapter and its cable, then `cell recover`, which opens the bus again.",
            )

    @contextmanager
    def listening(self) -> Iterator[list[tuple[float, can.Message]]]:
        """Every frame that comes while the context is open, whoever sent it, with its time on the system's monotonic
        clock, in a list that grows. One at a time."""
        heard: list[tuple[float, can.Message]] = []
        self._heard = heard
        try:
            yield heard
        finally:
            self._heard = None

    def send_frame(self, frame: can.Message, what: str) -> None:
        """Send a frame; `what` names it in errors. Raises as `check` does."""
        self.check()
        try:
            with self._sending:
                self._bus.send(frame, timeout=SEND_TIMEOUT_S)
            self._statistics.traffic.sent(frame)
        except (can.CanError, OSError) as error:
            self._fail(f"sending {what}: {error}")
            self.check()

    def say_in_the_end(self, frames: Sequence[can.Message]) -> None:
        """These frames are sent when this process is killed; a second call changes nothing. Nothing where the bus has
        no file of its own: there the vehicle has to stop by itself."""
        if self._last_words is None:
            self._last_words = self._after_death(frames)

    def require_unspoken(self) -> None:
        """As `LastWords.require_unspoken`."""
        if self._last_words is not None:
            self._last_words.require_unspoken("vehicle.owner_frozen")

    def close(self) -> None:
        """End the receive thread and shut the bus down; idempotent."""
        if self._closing.is_set():
            return
        self._closing.set()
        if self._thread is not threading.current_thread():
            self._thread.join(10 * RECEIVE_TIMEOUT_S + SEND_TIMEOUT_S)
        # A bus whose peer is gone cannot say goodbye; its socket is released all the same.
        with suppress(can.CanError, OSError), self._sending:
            if self._last_words is not None:
                self._last_words.close()
            self._bus.shutdown()

    def _open(self, interface: str, channel: str, bitrate: int) -> can.BusABC:
        settings: dict[str, Any] = {"bitrate": bitrate}
        if interface == "slcan" and channel.startswith("socket://"):
            # The default waits 2 s for a serial adapter to boot, which one behind a socket has done already.
            settings.setdefault("sleep_after_open", 0.0)
            # Its default of 1 ms makes an idle receiver wake up a thousand times a second.
            settings.setdefault("timeout", 0.02)
            channel = channel.replace("socket://", SCHEME, 1)
        try:
            bus: can.BusABC = can.Bus(channel=channel, interface=interface, **settings)
            if interface == "slcan":
                self._hear_refusals(bus)
            return bus
        except can.CanInterfaceNotImplementedError as error:
            raise ConfigError(f"{self._name}: CAN interface {interface!r} cannot be used: {error}") from error
        except (can.CanError, OSError, ValueError) as error:
            raise NotConnectedError(
                self._name,
                f"CAN bus {self._address} at {bitrate} bit/s cannot be opened: {error}. "
                "Check interface, channel and adapter",
            ) from error

    def _hear_refusals(self, bus: Any) -> None:
        """python-can passes over what an adapter answers to the frames that it is given."""
        read = bus._read

        def reading(timeout: float | None) -> str | None:
            said: str | None = read(timeout)
            if said == _BELL:
                self._refused += 1
                self._statistics.count(REFUSED)
            elif said in _TAKEN:
                self._refused = 0
            return said

        bus._read = reading

    def _after_death(self, frames: Sequence[can.Message]) -> LastWords | None:
        bus: Any = self._bus
        if self._interface == "slcan":
            # The first return ends a frame that was cut off.
            words = [b"\rt%03X%d%s\r" % (f.arbitration_id, f.dlc, f.data.hex().encode()) for f in frames]
            port = descriptor_of(bus.serialPortOrig)
        elif self._interface == "socketcan":
            words = [struct.pack("=IB3x8s", f.arbitration_id, f.dlc, bytes(f.data)) for f in frames]
            port = descriptor_of(bus)
        else:
            return None
        return None if port is None else LastWords(self._name, port, words)

    def _fail(self, reason: str) -> None:
        if self._failure is None:
            self._failure = reason
            self._statistics.count("link_lost")

    def _run(self) -> None:
        while not self._closing.is_set() and self._failure is None:
            try:
                begun = time.monotonic()
                try:
                    frame = self._bus.recv(RECEIVE_TIMEOUT_S)
                finally:
                    # Also while others talk on the bus, or what comes is no frame. A thread that was not run did not
                    # wait any longer.
                    self._idle(min(time.monotonic() - begun, RECEIVE_TIMEOUT_S))
                if self._refused >= MOST_REFUSED:
                    self._fail(
                        f"the adapter refuses every frame, {self._refused} in a row: see whether it listens only, is "
                        "bus-off or has another bit rate"
                    )
                if frame is not None:
                    if (heard := self._heard) is not None:
                        heard.append((time.monotonic(), frame))
                    self._statistics.traffic.received(frame)
                    self._handle(frame)
            except (ValueError, IndexError):
                self._statistics.count("malformed")
            except Exception as error:
                self._fail(f"receiving: {error}")

    def _handle(self, frame: can.Message) -> None:
        if frame.is_error_frame:
            self._statistics.count("error_frames")
            return
        self._receive(frame)
