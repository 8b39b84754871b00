"""AgileX protocol v2 on a CAN bus: messages by their names in the DBC, in its units.

Descriptions of the protocol differ in how a vehicle is asked for its version. The maker's SDK sends 01 to 0x4A1 and
reads ten frames of text there. The SCOUT manual 1.3.0 asks at 0x411 and reads four numbers at 0x41A. Some firmware
answers neither: then the version is unknown, which is no fault."""

import struct
from collections.abc import Callable, Mapping
from importlib.resources import as_file, files
from typing import cast

import can
import cantools
from cantools.database.can import Database, Message

from drivers.interfaces import LinkStatistics
from drivers.vehicle.can_link import CanLink, data_frame


def load_database() -> Database:
    """The AgileX v2 messages of `agilex_v2.dbc`."""
    with as_file(files("drivers.vehicle") / "agilex_v2.dbc") as path:
        return cast(Database, cantools.database.load_file(path))


class AgilexLink(CanLink):
    """A `CanLink`; `told` is called with each known message's name and signal values. `wanted` names the messages that
    are decoded; others are ignored. Raises what `CanLink` does."""

    def __init__(
        self, name: str, interface: str, channel: str, *, bitrate: int,
        database: Database, wanted: frozenset[str], told: Callable[[str, dict[str, float]], None],
        idle: Callable[[float], None], statistics: LinkStatistics,
    ) -> None:  # fmt: skip
        self._database = database
        self._wanted: dict[int, Message] = {
            message.frame_id: message for message in database.messages if message.name in wanted
        }
        self._told = told
        super().__init__(
            name, interface, channel, bitrate=bitrate, receive=self._take, idle=idle,
            statistics=statistics, alone="the vehicle stops by itself 0.5 s after the last command",
        )  # fmt: skip

    def send(self, name: str, **signals: float) -> None:
        """Send the message `name`; signals in the units of the DBC. Raises as `check` does."""
        self.check()
        if name == "ControlModeCommand":
            # Who never commanded it has nothing to end.
            zero = self._frame("MotionCommand", Speed=0.0, YawRate=0.0, LateralSpeed=0.0, Steering=0.0)
            self.say_in_the_end((*[zero] * 3, self._frame("BrakeCommand", Locked=1)))
        self.send_frame(self._frame(name, **signals), name)

    def send_data(self, identifier: int, data: bytes) -> None:
        """Send a frame that is not in the message table. Raises as `check` does."""
        self.send_frame(data_frame(identifier, data), f"0x{identifier:03X}")

    def _frame(self, name: str, **signals: float) -> can.Message:
        message = self._database.get_message_by_name(name)
        return data_frame(message.frame_id, message.encode(signals))

    def _take(self, frame: can.Message) -> None:
        message = self._wanted.get(frame.arbitration_id)
        if message is None or frame.is_extended_id or frame.is_remote_frame:
            return
        if len(frame.data) != message.length:
            self._statistics.count("malformed")
            return
        self._told(message.name, cast(dict[str, float], message.decode(bytes(frame.data), decode_choices=False)))


TEXT_REQUEST = (0x4A1, b"\x01")
"""Identifier and data of the SDK's request."""
ANSWERS = ("VersionResponse", "VersionNumbers")
UNKNOWN = "unknown"
_TEXT_FRAMES = 10
_NUMBERS = ("ControllerHardware", "DriverHardware", "ControllerSoftware", "DriverSoftware")
_PRINTABLE = frozenset((0, *range(32, 127)))


class VersionAnswer:
    """Collects the answer to one request, frame by frame."""

    def __init__(self) -> None:
        self._text: list[bytes] = []
        self._numbers: tuple[int, ...] | None = None

    def take(self, message: str, signals: Mapping[str, float]) -> None:
        """Take a frame of one of the `ANSWERS`."""
        numbers = tuple(int(signals[name]) for name in _NUMBERS)
        data = struct.pack(">4H", *numbers)
        # A text may be shorter than its frames: what follows it is zeros, and no numbers.
        if message == "VersionResponse" and all(byte in _PRINTABLE for byte in data) and (data[0] or self._text):
            self._text.append(data)
        elif not self._text or message == "VersionNumbers":
            self._numbers = numbers

    def is_complete(self) -> bool:
        """True once no more is to come."""
        return self._numbers is not None or len(self._text) >= _TEXT_FRAMES

    def describe(self) -> str:
        """The version in one line, or that it is unknown."""
        if len(self._text) >= _TEXT_FRAMES:
            text = b"".join(self._text[:_TEXT_FRAMES]).replace(b"\0", b" ").decode("ascii")
            return " ".join(text.split()) or UNKNOWN
        if self._numbers is None:
            return UNKNOWN
        controller, driver, software, drivers = self._numbers
        return f"hardware {controller}/{driver}, controller {software}, drivers {drivers}"
