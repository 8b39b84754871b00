"""Modbus RTU to one drive: the one place through which every frame passes.

One frame at a time, with the silence between frames that the line's speed asks for; a reply belongs to its request or
is thrown away; what may be said twice is tried twice. A stop overtakes: commands that were issued before it and have
not been sent yet are refused. Source: docs/how-to/other-makes.md, section 1.
"""

import time
from collections.abc import Sequence

from drivers.clock import Clock
from drivers.errors import DeadlineError, DeviceFault
from drivers.interfaces import LinkStatistics
from drivers.rail.axis import QUIET_S, RailLink
from drivers.rail.modbus.make import ActionConfig

REPLY_TIMEOUT_S = 0.3
"""Wall seconds for a reply besides the time that its bits take: drives answer within some ms."""
READ, READ_INPUT, WRITE_ONE, WRITE_SEVERAL = 3, 4, 6, 16
_EXCEPTIONS = {
    1: "it does not know this function",
    2: "it has no such register",
    3: "it does not take this value",
    4: "it failed",
    5: "it needs longer",
    6: "it is busy",
}
_BUSY = (5, 6)
_BITS_PER_BYTE = 11
_SILENCE_BYTES = 3.5
_LEAST_SILENCE_S = 0.00175
"""The standard's, above 19200 baud."""
_IN_STEP_S = 0.25
"""Wall seconds for the reply to a question that is asked to be in step again."""
_ATTEMPTS = 2
_LONGEST_BYTES = 16
"""Of a request or a reply."""


class FrameError(Exception):
    """What came is no reply to what was asked."""


class ModbusRefused(DeviceFault):
    """The drive answered with the exception `number`."""

    def __init__(self, device: str, number: int, what: str) -> None:
        super().__init__(
            device,
            "modbus.refused",
            f"the drive refused {what}: {_EXCEPTIONS.get(number, 'for a reason of its own')} (exception {number})",
            recoverable=False,
            hint="Compare rail.registers with the manual of this drive and its firmware; addresses count from 0, as on "
            "the wire.",
        )
        self.number = number


class ModbusLink(RailLink):
    """A serial port (device path or pyserial URL) with the drive `unit` on it. Raises `NotConnectedError` when the port
    cannot be opened."""

    DRIVE, REPLY_S = "drive", REPLY_TIMEOUT_S

    def __init__(
        self, name: str, url: str, *, unit: int, baud: int, parity: str, stop_bits: int, stop_action: ActionConfig,
        clock: Clock, statistics: LinkStatistics,
    ) -> None:  # fmt: skip
        byte_s = _BITS_PER_BYTE / baud
        # Set once: to change it asks the system for the port's settings each time.
        timeout = REPLY_TIMEOUT_S + 2 * _LONGEST_BYTES * byte_s
        super().__init__(name, url, statistics, baud=baud, timeout=timeout, parity=parity, stop_bits=stop_bits)
        self._unit = unit
        self._wire = f"{baud} baud, parity {parity}, {stop_bits} stop bit{'s' * (stop_bits - 1)}"
        self._silence_s = max(_LEAST_SILENCE_S, _SILENCE_BYTES * byte_s)
        self._clock = clock
        self._stop_action = stop_action
        self._echoes: bool | None = None
        self._quiet_since = 0.0

    def read(self, address: int, count: int, *, input: bool = False) -> list[int]:
        """Read `count` registers."""
        return self.read_stamped(address, count, input=input)[0]

    def read_stamped(self, address: int, count: int, *, input: bool = False) -> tuple[list[int], float, float]:
        """Read registers: values, host time of the middle of the round trip, round trip; in clock seconds."""
        if self._last_words is not None:
            self._last_words.require_unspoken("rail.owner_frozen")
        request = _frame(self._unit, READ_INPUT if input else READ, *_words(address, count))
        data, stamp, round_trip = self._exchange(request, 5 + 2 * count, f"to read register {address:#06x}", None)
        if data[2] != 2 * count:
            raise DeadlineError(self.name, f"{data[2]} bytes of registers came, {2 * count} were asked for")
        body = data[3:-2]
        return [body[k] << 8 | body[k + 1] for k in range(0, len(body), 2)], stamp, round_trip

    def write(self, address: int, values: Sequence[int], *, issued: int | None = None) -> None:
        """Write registers, a single one by the function for it; `Aborted` when a stop came after `issued`."""
        if len(values) == 1:
            request = _frame(self._unit, WRITE_ONE, *_words(address, values[0]))
        else:
            request = _frame(
                self._unit, WRITE_SEVERAL, *_words(address, len(values)), 2 * len(values), *_words(*values)
            )
        told = ", ".join(str(value) for value in values)
        data, _, _ = self._exchange(request, 8, f"to write {told} to register {address:#06x}", issued)
        if data[2:6] != request[2:6]:
            raise DeadlineError(
                self.name, f"{data.hex(' ')} came, which does not confirm the register that was written"
            )

    def do(self, action: ActionConfig, *, issued: int | None = None, moves: bool = False) -> None:
        """Give a command; one that `moves` is also ended when this process dies."""
        if moves:
            self._stop_after_death()
        for value in action.writes:
            self.write(action.address, [value], issued=issued)

    def stop(self) -> None:
        """Give the stop command; commands issued earlier are refused."""
        with self.stops.one_more():
            self.do(self._stop_action)

    def _stop_words(self) -> list[bytes]:
        action = self._stop_action
        words = [_frame(self._unit, WRITE_ONE, *_words(action.address, value)) for value in action.writes]
        # Twice: the owner may have died in the middle of a frame of its own, which spoils the first one.
        return words * 2

    def _exchange(self, request: bytes, length: int, what: str, issued: int | None) -> tuple[bytes, float, float]:
        """The choke point: send `request`, give its reply of `length` bytes, the middle of the round trip, its length.

        Everything this driver sends means the same when it is heard twice, so a lost or damaged reply, and a drive that
        is busy, is asked once more. `issued` is the count of stops when the caller decided to move.
        """
        failure: Exception = FrameError("nothing came")
        for attempt in range(_ATTEMPTS):
            if attempt:
                self._statistics.count("retries")
            with self._line(issued):
                try:
                    return self._once(request, length, what)
                except FrameError as error:
                    failure = error
                    self._statistics.count("bad_replies")
                    self._in_step = False
                except ModbusRefused as refused:
                    if refused.number not in _BUSY or attempt + 1 == _ATTEMPTS:
                        raise
                    time.sleep(QUIET_S)
        raise DeadlineError(
            self.name,
            f"no valid reply {what} within {REPLY_TIMEOUT_S} s, {_ATTEMPTS} attempts ({failure}). Check the drive's "
            f"number {self._unit} (rail.unit), the line ({self._wire}: rail.baud, rail.parity, rail.stop_bits), the "
            "wiring of A and B, and its supply",
        ) from failure

    def _once(self, request: bytes, length: int, what: str) -> tuple[bytes, float, float]:
        if self._port.in_waiting:
            self._statistics.count("stale_input")
            self._rest()
        if not self._in_step:
            self._in_step = self._got_in_step(request)
        if not self._in_step:
            # Sent all the same: it may be a stop, and a drive that cannot be heard may hear.
            self._port.write(request)
            raise FrameError("no reply came to the question after the one before it")
        left = self._quiet_since + self._silence_s - time.monotonic()
        if left > 0:
            time.sleep(left)
        before = self._clock.now()
        self._port.write(request)
        self._statistics.traffic.sent(request)
        if self._echoes is None:
            data = self._learn_echo(request)
        else:
            if self._echoes:
                self._get(len(request))
            data = self._get(5)
            if data[1] & 0x80 == 0:
                data += self._get(length - 5)
        after = self._clock.now()
        self._quiet_since = time.monotonic()
        if len(data) < 5 or _crc(data[:-2]) != data[-2:]:
            raise FrameError(f"no frame with the right checksum came: {data.hex(' ') or 'nothing'}")
        if data[0] != request[0] or data[1] & 0x7F != request[1]:
            raise FrameError(f"a reply to something else came, {data.hex(' ')}")
        if data[1] & 0x80:
            raise ModbusRefused(self.name, data[2], what)
        if len(data) != length:
            raise FrameError(f"a frame of {len(data)} bytes came instead of {length}, {data.hex(' ')}")
        self._statistics.add_round_trip(self._clock.wall(after - before))
        return data, 0.5 * (before + after), after - before

    def _got_in_step(self, request: bytes) -> bool:
        """Whether the next reply will be that to `request`: after one that was missing or wrong it may still come.

        A reply names neither register nor question. So one register is read where several were, or two where one was:
        once that reply is there, whatever it says, none to an earlier question can follow. False when it does not come.
        """
        self._rest()
        reads = request[1] in (READ, READ_INPUT)
        count = 2 if reads and request[4:6] == _words(1) else 1
        function = request[1] if reads else READ
        fence = _frame(self._unit, function, *request[2:4], *_words(count))
        time.sleep(self._silence_s)
        self._port.write(fence)
        came, end = b"", time.monotonic() + _IN_STEP_S
        while time.monotonic() < end:
            came += self._rest()
            for length, code in ((5 + 2 * count, function), (5, function | 0x80)):
                reply = came[-length:]
                if len(reply) == length and reply[:2] == bytes([self._unit, code]) and _crc(reply[:-2]) == reply[-2:]:
                    self._quiet_since = time.monotonic()
                    return True
        return False

    def _learn_echo(self, request: bytes) -> bytes:
        """The first reply, and whether this line repeats what is sent: many adapters to two wires hear themselves."""
        came = self._get(1) + self._rest()
        self._statistics.traffic.received(came[1:])
        echoed = came.startswith(request)
        reply = came[len(request) :] if echoed else came
        if len(reply) >= 5 and _crc(reply[:-2]) == reply[-2:]:
            self._echoes = echoed
        return reply

    def _get(self, count: int) -> bytes:
        data = bytes(self._port.read(count))
        self._statistics.traffic.received(data)
        if len(data) < count:
            self._statistics.count("timeouts")
            raise FrameError(f"{len(data)} of {count} bytes came")
        return data


def _words(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "big") for value in values)


def _frame(unit: int, function: int, *body: int) -> bytes:
    frame = bytes([unit, function, *body])
    return frame + _crc(frame)


def _crc(data: bytes) -> bytes:
    """The checksum of a frame, its low byte first (polynomial 0xA001, from 0xFFFF)."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value.to_bytes(2, "little")
