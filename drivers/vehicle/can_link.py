"""The CAN bus with its message table: sending, and a receive thread that never dies unnoticed.

python-can's own notifier thread ends silently on a bus error; this one keeps the reason, and every later use of the
link raises it.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.resources import as_file, files
from typing import Any, cast

import can
import cantools
import serial
from cantools.database.can import Database, Message

from drivers.errors import ConfigError, DeviceFault, NotConnectedError
from drivers.interfaces import LinkStatistics
from drivers.last_words import LastWords, descriptor_of
from drivers.vehicle.protocol_bufsocket import SCHEME

if "drivers.vehicle" not in serial.protocol_handler_packages:
    serial.protocol_handler_packages.append("drivers.vehicle")

RECEIVE_TIMEOUT_S = 0.1
SEND_TIMEOUT_S = 0.5


def load_database() -> Database:
    """The AgileX v2 messages of `agilex_v2.dbc`."""
    with as_file(files("drivers.vehicle") / "agilex_v2.dbc") as path:
        return cast(Database, cantools.database.load_file(path))


class CanLink:
    """An open CAN bus; `receive` is called in the receive thread with each known message's name and signal values,
    and `idle` with the seconds on the wall for which it has waited before each frame, whoever sent that.

    `wanted` names the messages that are decoded; others are ignored. Raises `NotConnectedError` when the bus cannot be
    opened, `ConfigError` when python-can has no such interface.
    """

    def __init__(
        self,
        name: str,
        interface: str,
        channel: str,
        *,
        bitrate: int,
        options: Mapping[str, Any],
        database: Database,
        wanted: frozenset[str],
        receive: Callable[[str, dict[str, float]], None],
        idle: Callable[[float], None],
        statistics: LinkStatistics,
    ) -> None:
        self._name = name
        self._address = f"{interface}:{channel}"
        self._database = database
        self._wanted: dict[int, Message] = {
            message.frame_id: message for message in database.messages if message.name in wanted
        }
        self._receive = receive
        self._idle = idle
        self._statistics = statistics
        self._sending = threading.Lock()
        self._closing = threading.Event()
        self._failure: str | None = None
        self._heard: list[tuple[float, can.Message]] | None = None
        self._bus = self._open(interface, channel, bitrate, options)
        self._interface = interface
        self._last_words: LastWords | None = None
        self._thread = threading.Thread(target=self._run, name=f"{name} receiver", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """True while the bus works and its receive thread runs."""
        return self._failure is None and self._thread.is_alive()

    def check(self) -> None:
        """Raise `NotConnectedError` after `close`, `DeviceFault` (vehicle.link_lost) when the bus has failed."""
        if self._closing.is_set():
            raise NotConnectedError(self._name, "the vehicle was closed. Open it again")
        if not self.alive:
            raise DeviceFault(
                self._name,
                "vehicle.link_lost",
                f"the CAN bus at {self._address} failed: {self._failure or 'the receive thread has ended'}; "
                "the vehicle stops by itself 0.5 s after the last command",
                recoverable=True,
                hint="Check the adapter and its cable, then enable() the vehicle, which opens the bus again.",
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

    def send(self, name: str, **signals: float) -> None:
        """Send the message `name`; signals in the units of the DBC. Raises as `check` does."""
        self._send(name, self._frame(name, **signals))

    def send_data(self, identifier: int, data: bytes) -> None:
        """Send a frame that is not in the message table. Raises as `check` does."""
        self._send(f"0x{identifier:03X}", can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def _send(self, name: str, frame: can.Message) -> None:
        self.check()
        if name == "ControlModeCommand" and self._last_words is None:
            # Who never commanded it has nothing to end.
            self._last_words = self._stop_after_death(self._interface)
        try:
            with self._sending:
                self._bus.send(frame, timeout=SEND_TIMEOUT_S)
        except (can.CanError, OSError) as error:
            self._fail(f"sending {name}: {error}")
            self.check()

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

    def _open(self, interface: str, channel: str, bitrate: int, options: Mapping[str, Any]) -> can.BusABC:
        settings: dict[str, Any] = {"bitrate": bitrate, **options}
        if interface == "slcan" and channel.startswith("socket://"):
            # The default waits 2 s for a serial adapter to boot, which one behind a socket has done already.
            settings.setdefault("sleep_after_open", 0.0)
            # Its default of 1 ms makes an idle receiver wake up a thousand times a second.
            settings.setdefault("timeout", 0.02)
            channel = channel.replace("socket://", SCHEME, 1)
        try:
            return can.Bus(channel=channel, interface=interface, **settings)
        except can.CanInterfaceNotImplementedError as error:
            raise ConfigError(f"{self._name}: CAN interface {interface!r} cannot be used: {error}") from error
        except (can.CanError, OSError, ValueError) as error:
            raise NotConnectedError(
                self._name,
                f"CAN bus {self._address} at {bitrate} bit/s cannot be opened: {error}. "
                "Check interface, channel and adapter",
            ) from error

    def _stop_after_death(self, interface: str) -> LastWords | None:
        """Zero velocity, then the brake, when this process is killed; None where the bus has no file of its own.

        There the vehicle stops by itself, 0.5 s after the last command.
        """
        zero = self._frame("MotionCommand", Speed=0.0, YawRate=0.0, LateralSpeed=0.0, Steering=0.0)
        frames = (*[zero] * 3, self._frame("BrakeCommand", Locked=1))
        bus: Any = self._bus
        if interface == "slcan":
            # The first return ends a frame that was cut off.
            words = [b"\rt%03X%d%s\r" % (f.arbitration_id, f.dlc, f.data.hex().encode()) for f in frames]
            port = descriptor_of(bus.serialPortOrig)
        elif interface == "socketcan":
            words = [struct.pack("=IB3x8s", f.arbitration_id, f.dlc, bytes(f.data)) for f in frames]
            port = descriptor_of(bus)
        else:
            return None
        return None if port is None else LastWords(self._name, port, words)

    def _frame(self, name: str, **signals: float) -> can.Message:
        message = self._database.get_message_by_name(name)
        return can.Message(arbitration_id=message.frame_id, data=message.encode(signals), is_extended_id=False)

    def _fail(self, reason: str) -> None:
        if self._failure is None:
            self._failure = reason
            self._statistics.count("link_lost")

    def _run(self) -> None:
        while not self._closing.is_set() and self._failure is None:
            try:
                begun = time.monotonic()
                frame = self._bus.recv(RECEIVE_TIMEOUT_S)
                # Also while others talk on the bus. A thread that was not run did not wait any longer.
                self._idle(min(time.monotonic() - begun, RECEIVE_TIMEOUT_S))
                if frame is not None:
                    if (heard := self._heard) is not None:
                        heard.append((time.monotonic(), frame))
                    self._handle(frame)
            except (ValueError, IndexError):
                self._statistics.count("malformed")
            except Exception as error:
                self._fail(f"receiving: {error}")

    def _handle(self, frame: can.Message) -> None:
        if frame.is_error_frame:
            self._statistics.count("error_frames")
            return
        message = self._wanted.get(frame.arbitration_id)
        if message is None or frame.is_extended_id or frame.is_remote_frame:
            return
        if len(frame.data) != message.length:
            self._statistics.count("malformed")
            return
        self._receive(message.name, cast(dict[str, float], message.decode(bytes(frame.data), decode_choices=False)))
