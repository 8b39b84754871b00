"""TMCL's telegrams, nine bytes each way, and the serial line: the one place through which every telegram passes.

One telegram at a time; a reply belongs to its request or is thrown away; what may be said twice is tried twice. A stop
overtakes: commands that were issued before it and have not been sent yet are refused.

Source: the maker's TMCL firmware manual; docs/reference/protocols.md, section 2.
"""

import struct
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVar

from drivers.clock import Clock
from drivers.errors import DeadlineError, DeviceFault
from drivers.interfaces import LinkStatistics
from drivers.rail.axis import RailLink

TELEGRAM_BYTES = 9
STATUS_OK = 100
_BODY = struct.Struct(">BBBBi")
STATUS_TEXT = {
    1: "wrong checksum",
    2: "invalid command",
    3: "wrong type",
    4: "invalid value",
    5: "EEPROM locked",
    6: "command not available",
}
"""What a module says when it refuses a command."""


class TmclCommand(IntEnum):
    """Command numbers."""

    ROTATE_RIGHT = 1
    MOTOR_STOP = 3
    MOVE_TO = 4
    SET_AXIS = 5
    GET_AXIS = 6
    SET_GLOBAL = 9
    GET_GLOBAL = 10
    REFERENCE_SEARCH = 13
    FIRMWARE = 136


class Axis(IntEnum):
    """Axis parameters; positions in microsteps, velocities in pulses per second (TMCM-1241, TMCM-1260)."""

    TARGET_POSITION = 0
    POSITION = 1
    VELOCITY = 3
    MAX_VELOCITY = 4
    MAX_ACCELERATION = 5
    POSITION_REACHED = 8
    HOME_SWITCH = 9
    RIGHT_SWITCH = 10
    LEFT_SWITCH = 11
    RAMP_15 = 15
    RAMP_16 = 16
    MAX_DECELERATION = 17
    RAMP_18 = 18
    RAMP_19 = 19
    STOP_VELOCITY = 20
    MICROSTEP_RESOLUTION = 140
    REFERENCE_MODE = 193
    REFERENCE_SEARCH_SPEED = 194
    REFERENCE_SWITCH_SPEED = 195
    EXTENDED_ERRORS = 207
    DRIVER_ERRORS = 208
    REVERSE_SHAFT = 251
    UNIT_MODE = 255


class ReferenceSearch(IntEnum):
    """Types of the reference-search command."""

    START = 0
    STOP = 1
    STATUS = 2


class TelegramError(ValueError):
    """A reply that does not answer the request: wrong length, checksum, module address or command."""


@dataclass(frozen=True)
class TmclRequest:
    """One command to a module; `value` is a signed 32-bit number."""

    address: int
    command: int
    type: int
    motor: int
    value: int = 0

    def encode(self) -> bytes:
        """The nine bytes of the telegram; `ValueError` when a field does not fit."""
        try:
            body = _BODY.pack(self.address, self.command, self.type, self.motor, self.value)
        except struct.error as error:
            raise ValueError(f"{self} does not fit a TMCL telegram: {error}") from error
        return body + bytes([checksum(body)])


@dataclass(frozen=True)
class TmclReply:
    """One answer; `value` is a signed 32-bit number."""

    host: int
    module: int
    status: int
    command: int
    value: int


def checksum(body: bytes) -> int:
    """Sum of the bytes, modulo 256."""
    return sum(body) & 0xFF


def decode_reply(data: bytes, request: TmclRequest) -> TmclReply:
    """Read the answer to `request`. Raises `TelegramError` when `data` is not nine bytes, fails its checksum, or comes
    from another module or from another command: a late answer to an earlier question is not this one's."""
    if len(data) != TELEGRAM_BYTES:
        raise TelegramError(f"{len(data)} bytes instead of {TELEGRAM_BYTES}")
    if checksum(data[:-1]) != data[-1]:
        raise TelegramError(f"checksum 0x{data[-1]:02x} instead of 0x{checksum(data[:-1]):02x}")
    reply = TmclReply(*_BODY.unpack(data[:-1]))
    if reply.module != request.address:
        raise TelegramError(f"answer of module {reply.module} instead of {request.address}")
    if reply.command != request.command:
        raise TelegramError(f"answer to command {reply.command} instead of {request.command}")
    return reply


def decode_firmware(data: bytes) -> str:
    """The answer to `TmclCommand.FIRMWARE`, type 0: the host's address, then eight ASCII characters, no checksum."""
    text = data[1:]
    if len(data) != TELEGRAM_BYTES or not text.isascii() or not text.decode("ascii").isprintable():
        raise TelegramError(f"{data.hex(' ')} is not a firmware text")
    return text.decode("ascii").strip()


REPLY_TIMEOUT_S = 0.5
"""Wall seconds for a reply: modules answer within a few ms, a loaded machine may add tens."""
WRONG_CHECKSUM, NO_SUCH_TYPE, WRONG_VALUE = 1, 3, 4
_ATTEMPTS = 2
_IN_STEP_S = 0.25
"""Wall seconds for the reply to a question that is asked to be in step again."""
_USER_BANK = 2
_FENCE_TYPE = 1
"""Axis parameter 1 is the position; that a module has no such global parameter does not matter."""

_STOPS = (TmclCommand.MOTOR_STOP, TmclCommand.REFERENCE_SEARCH)
"""Sent whatever happened before."""

Answer = TypeVar("Answer")


class CommandRefused(DeviceFault):
    """The module refused a command with the status code `status`."""

    def __init__(self, device: str, status: int, message: str) -> None:
        super().__init__(
            device, "tmcl.refused", message, recoverable=False,
            hint="Check that the value is in the module's range (pulses per second) and that it has this axis.",
        )  # fmt: skip
        self.status = status


class TmclLink(RailLink):
    """A serial port (device path or pyserial URL) with one module at `address` on it. Raises `NotConnectedError` when
    the port cannot be opened."""

    DRIVE, REPLY_S = "module", REPLY_TIMEOUT_S

    def __init__(
        self, name: str, url: str, *, address: int, motor: int, baud: int, clock: Clock, statistics: LinkStatistics
    ) -> None:
        super().__init__(name, url, statistics, baud=baud, timeout=REPLY_TIMEOUT_S)
        self._address = address
        self._motor = motor
        self._baud = baud
        self._clock = clock

    def _stop_words(self) -> list[bytes]:
        stops = (
            TmclRequest(self._address, TmclCommand.REFERENCE_SEARCH, ReferenceSearch.STOP, self._motor),
            TmclRequest(self._address, TmclCommand.MOTOR_STOP, 0, self._motor),
        )
        return [stop.encode() for stop in stops]

    def get(self, axis: Axis) -> int:
        """Read an axis parameter."""
        return self._command(TmclCommand.GET_AXIS, axis).value

    def get_if_there(self, axis: Axis) -> int | None:
        """Read an axis parameter; None for a module that does not have it."""
        try:
            return self.get(axis)
        except CommandRefused as refused:
            if refused.status == NO_SUCH_TYPE:
                return None
            raise

    def get_stamped(self, axis: Axis) -> tuple[int, float, float]:
        """Read an axis parameter: value, host time of the middle of the round trip, round trip; in clock seconds."""
        request = TmclRequest(self._address, TmclCommand.GET_AXIS, axis, self._motor)
        return self._exchange(request, lambda data: self._checked(data, request).value, issued=None)

    def set(self, axis: Axis, value: int, *, issued: int | None = None) -> None:
        """Write an axis parameter."""
        self._command(TmclCommand.SET_AXIS, axis, value, issued=issued)

    def move_to(self, microsteps: int, *, issued: int) -> None:
        """Start a move to an absolute position, unless a stop came after `issued`."""
        self._stop_after_death()
        self._command(TmclCommand.MOVE_TO, 0, microsteps, issued=issued)

    def reference_search(self, kind: int, *, issued: int | None = None) -> int:
        """Start, stop or query the reference search; the query's value is 0 once it is done."""
        if kind == ReferenceSearch.START:
            self._stop_after_death()
        return self._command(TmclCommand.REFERENCE_SEARCH, kind, issued=issued).value

    def stop(self) -> None:
        """Stop the reference search, whoever began it, and the motor; commands issued earlier are refused."""
        with self.stops.one_more():
            try:
                self.reference_search(ReferenceSearch.STOP)
            finally:
                self._command(TmclCommand.MOTOR_STOP, 0)

    def firmware(self) -> str:
        """The module's firmware text, like 1241V123."""
        request = TmclRequest(self._address, TmclCommand.FIRMWARE, 0, self._motor)
        return self._exchange(request, decode_firmware, issued=None)[0]

    def user_variable(self, index: int) -> int:
        """The module's user variable `index` (global parameter bank 2)."""
        request = TmclRequest(self._address, TmclCommand.GET_GLOBAL, index, _USER_BANK)
        return self._exchange(request, lambda data: self._checked(data, request).value, issued=None)[0]

    def set_user_variable(self, index: int, value: int, *, issued: int | None = None) -> None:
        """Write the module's user variable `index`; those from 56 on are lost when the module is reset."""
        request = TmclRequest(self._address, TmclCommand.SET_GLOBAL, index, _USER_BANK, value)
        self._exchange(request, lambda data: self._checked(data, request), issued=issued)

    def _command(self, command: TmclCommand, kind: int, value: int = 0, *, issued: int | None = None) -> TmclReply:
        request = TmclRequest(self._address, command, kind, self._motor, value)
        return self._exchange(request, lambda data: self._checked(data, request), issued=issued)[0]

    def _checked(self, data: bytes, request: TmclRequest) -> TmclReply:
        reply = decode_reply(data, request)
        if reply.status == WRONG_CHECKSUM:
            raise TelegramError("the module says that the request came with a wrong checksum")
        if reply.status != STATUS_OK:
            reason = STATUS_TEXT.get(reply.status, f"status {reply.status}")
            raise CommandRefused(
                self.name,
                reply.status,
                f"the module refused command {request.command}, type {request.type}, value {request.value}: {reason}",
            )
        return reply

    def _exchange(
        self, request: TmclRequest, decode: Callable[[bytes], Answer], *, issued: int | None
    ) -> tuple[Answer, float, float]:
        """The choke point: send `request`, return the decoded reply, the middle of the round trip and its length.

        Everything this driver sends means the same when it is heard twice, so a lost or damaged reply is asked for
        once more. `issued` is the count of stops when the caller decided to move.
        """
        failure: TelegramError | None = None
        for attempt in range(_ATTEMPTS):
            with self._line(issued):
                if self._last_words is not None and request.command not in _STOPS:
                    self._last_words.require_unspoken("rail.owner_frozen")
                try:
                    return self._once(request, decode)
                except TelegramError as error:
                    # The first says most: the others may only not be in step any more.
                    failure = failure or error
                    self._in_step = False
            if attempt + 1 < _ATTEMPTS:
                self._statistics.count("retries")
        raise DeadlineError(
            self.name,
            f"no valid reply to command {request.command} type {request.type} within {REPLY_TIMEOUT_S} s, "
            f"{_ATTEMPTS} attempts ({failure}). Check module address {self._address} (rail.address), "
            f"rail.baud ({self._baud}; RS-485 and RS-232 of a new module have 9600) and the wiring",
        ) from failure

    def _once(self, request: TmclRequest, decode: Callable[[bytes], Answer]) -> tuple[Answer, float, float]:
        if self._port.in_waiting:
            self._statistics.count("stale_input")
            self._rest()
        if not self._in_step:
            self._in_step = self._got_in_step(request)
        if not self._in_step:
            # Sent all the same: it may be a stop, and a module that cannot be heard may hear.
            self._port.write(request.encode())
            raise TelegramError("no reply came to the question after the one before it")
        before = self._clock.now()
        sent = request.encode()
        traffic = self._statistics.traffic
        self._port.write(sent)
        traffic.sent(sent)
        data = self._port.read(TELEGRAM_BYTES)
        traffic.received(data)
        echoed = data == sent
        if echoed:
            # Many adapters to a two-wire line hear themselves. No reply looks like its request: a status of 100 is no
            # type of a command that is sent here.
            self._statistics.count("echoes")
            data = self._port.read(TELEGRAM_BYTES)
            traffic.received(data)
        after = self._clock.now()
        if len(data) < TELEGRAM_BYTES:
            self._statistics.count("timeouts")
            echo = " after the adapter's echo of the request" if echoed else ""
            raise TelegramError(f"{len(data)} of {TELEGRAM_BYTES} bytes came{echo}")
        try:
            answer = decode(data)
        except TelegramError:
            self._statistics.count("bad_replies")
            raise
        self._statistics.add_round_trip(self._clock.wall(after - before))
        return answer, 0.5 * (before + after), after - before

    def _got_in_step(self, request: TmclRequest) -> bool:
        """Whether the next reply will be that to `request`: after one that was missing or wrong it may still come.

        A reply names its command alone. So a harmless question of another command is asked: once its reply is there,
        none to an earlier one can follow. False when it does not come.
        """
        self._rest()
        question = TmclCommand.GET_AXIS if request.command == TmclCommand.GET_GLOBAL else TmclCommand.GET_GLOBAL
        fence = TmclRequest(self._address, question, _FENCE_TYPE, 0)
        sent = fence.encode()
        self._port.write(sent)
        end = time.monotonic() + _IN_STEP_S
        self._port.timeout = _IN_STEP_S
        try:
            while time.monotonic() < end and len(data := self._port.read(TELEGRAM_BYTES)) == TELEGRAM_BYTES:
                # A refusal is a reply as well; an adapter's echo of the question is none.
                if data != sent:
                    with suppress(TelegramError):
                        decode_reply(data, fence)
                        return True
        finally:
            self._port.timeout = REPLY_TIMEOUT_S
        return False
