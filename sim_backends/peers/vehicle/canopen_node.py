"""One node on a CANopen bus after CiA 301: object dictionary, SDO, PDOs, NMT, heartbeat, node guarding, emergencies.

Encoded here from the protocol, without any CANopen library. What the values mean is their owner's business.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass

from sim_backends.peers.vehicle.slcan import CanFrame

BOOTED, STOPPED, OPERATIONAL, PREPARING = 0x00, 0x04, 0x05, 0x7F
ABSENT, ABSENT_SUB, READ_ONLY = 0x06020000, 0x06090011, 0x06010002
UNMAPPABLE, TOO_LONG, WRONG_LENGTH, WRONG_VALUE = 0x06040041, 0x06040042, 0x06070010, 0x06090030
NOT_NOW, NO_SUCH_COMMAND = 0x08000022, 0x05040001
_INVALID = 1 << 31
_PDOS = 4
_COMMUNICATION_BIT = 0x10


class Abort(Exception):
    """Why an SDO is refused, by its code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:08X}h")
        self.code = code


@dataclass
class Value:
    """One value: packed as `form`, read by `read` instead of kept; `write` is told a new one and may raise `Abort`."""

    form: str
    value: int = 0
    writable: bool = False
    mappable: bool = False
    read: Callable[[], int] | None = None
    write: Callable[[int], None] | None = None

    @property
    def size(self) -> int:
        """Bytes."""
        return struct.calcsize(self.form)

    def packed(self) -> bytes:
        """As it goes over the bus; what does not fit wraps round as a counter does."""
        bits, number = 8 * self.size, self.value if self.read is None else self.read()
        number &= (1 << bits) - 1
        signed = self.form[-1].islower() and number >> (bits - 1)
        return struct.pack(self.form, number - (1 << bits) if signed else number)

    def set(self, data: bytes) -> None:
        """Take what came over the bus."""
        if len(data) != self.size:
            raise Abort(WRONG_LENGTH)
        (number,) = struct.unpack(self.form, data)
        if self.write is not None:
            self.write(number)
        self.value = number


class CanopenNode:
    """The node `number` with its owner's `values` and `texts`, by index and subindex; `send` puts a frame on the bus.

    `lost` is called when its master's heartbeat or guarding stays away, and when it is stopped or reset by NMT. Times
    are seconds on the wall, because watching a link is a matter of the wall also in a world that runs fast.
    """

    def __init__(
        self, number: int, values: dict[tuple[int, int], Value], texts: dict[tuple[int, int], bytes],
        send: Callable[[CanFrame], None], lost: Callable[[], None],
    ) -> None:  # fmt: skip
        self.number = number
        self.state = PREPARING
        self.silent = False
        self.error_register = 0
        self._send_frame, self._lost = send, lost
        self._values = {**self._communication(), **values}
        self._texts = texts
        self._text = b""
        self._toggle = 0
        self._syncs = 0
        self._beat = 0.0
        self._guard_toggle = 0
        self._heard: float | None = None
        """When its master gave its last sign of life; None before the first, and after one was missed."""

    def boot(self) -> None:
        """Say that it was switched on."""
        self.state, self._heard, self._guard_toggle = PREPARING, None, 0
        self._send(0x700 + self.number, bytes((BOOTED,)))

    def emergency(self, code: int) -> None:
        """Tell an emergency; 0 says that all errors are gone."""
        if code:
            self.error_register |= 0x01 | (_COMMUNICATION_BIT if code >> 8 == 0x81 else 0x20)
        else:
            self.error_register = 0
        if self.state != STOPPED:
            self._send(0x080 + self.number, struct.pack("<HB5x", code, self.error_register))

    def tick(self, now: float) -> None:
        """Send what is due, and see whether its master is still there."""
        period = 1e-3 * self._values[0x1017, 0].value
        if period and now - self._beat >= period:
            self._beat = now
            self._send(0x700 + self.number, bytes((self.state,)))
        consumer = self._values[0x1016, 1].value & 0xFFFF
        guarding = self._values[0x100C, 0].value * self._values[0x100D, 0].value
        allowed = 1e-3 * (consumer or guarding)
        if not allowed:
            self._heard = None
        elif self._heard is not None and now - self._heard > allowed:
            self._heard = None
            self.emergency(0x8130)
            behaviour = self._values[0x1029, 1].value
            if self.state == OPERATIONAL and behaviour != 1:
                self.state = STOPPED if behaviour == 2 else PREPARING
            self._lost()

    def receive(self, frame: CanFrame, now: float) -> None:
        """A frame from somebody else on the bus."""
        if frame.extended or self.silent:
            return
        if frame.remote:
            if frame.id == 0x700 + self.number:
                self._send(0x700 + self.number, bytes((self.state | self._guard_toggle,)))
                self._guard_toggle ^= 0x80
                self._heard = now
        elif frame.id == 0x000 and len(frame.data) == 2 and frame.data[1] in (0, self.number):
            self._manage(frame.data[0])
        elif frame.id == 0x080:
            self._synced()
        elif frame.id == 0x600 + self.number and self.state != STOPPED:
            if len(frame.data) == 8:
                self._serve(frame.data)
        elif frame.id == 0x700 + (self._values[0x1016, 1].value >> 16 & 0x7F):
            self._heard = now
        elif self.state == OPERATIONAL:
            self._take_pdo(frame)

    def _manage(self, command: int) -> None:
        if command in (0x01, 0x02, 0x80):
            self.state = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PREPARING}[command]
            if command == 0x02:
                self._lost()
        elif command in (0x81, 0x82):
            self._lost()
            self.boot()

    def _communication(self) -> dict[tuple[int, int], Value]:
        found = {
            (0x1001, 0): Value("<B", read=lambda: self.error_register), (0x1005, 0): Value("<I", 0x080, writable=True),
            (0x100C, 0): Value("<H", writable=True), (0x100D, 0): Value("<B", writable=True),
            (0x1016, 0): Value("<B", 1), (0x1016, 1): Value("<I", writable=True),
            (0x1017, 0): Value("<H", writable=True), (0x1029, 0): Value("<B", 1),
            (0x1029, 1): Value("<B", writable=True),
        }  # fmt: skip
        for k in range(_PDOS):
            for base, first in ((0x1400, 0x200), (0x1800, 0x180)):
                parameter, mapping = base + k, base + 0x200 + k
                found[parameter, 0] = Value("<B", 2)
                found[parameter, 1] = Value("<I", _INVALID | first + 0x100 * k + self.number, writable=True)
                found[parameter, 2] = Value("<B", 255, writable=True, write=_transmission)
                found[mapping, 0] = Value("<B", writable=True, write=self._counter(parameter, mapping))
                for sub in range(1, 9):
                    write = self._mapper(parameter, mapping)
                    found[mapping, sub] = Value("<I", writable=True, write=write)
        return found

    def _mapper(self, parameter: int, mapping: int) -> Callable[[int], None]:
        def write(entry: int) -> None:
            self._require_open(parameter)
            if self._values[mapping, 0].value:
                raise Abort(NOT_NOW)
            found = self._values.get((entry >> 16, entry >> 8 & 0xFF))
            if entry and (found is None or not found.mappable or 8 * found.size != entry & 0xFF):
                raise Abort(UNMAPPABLE)

        return write

    def _counter(self, parameter: int, mapping: int) -> Callable[[int], None]:
        def write(count: int) -> None:
            self._require_open(parameter)
            if count > 8:
                raise Abort(WRONG_VALUE)
            entries = [self._values[mapping, k].value for k in range(1, count + 1)]
            if not all(entries):
                raise Abort(UNMAPPABLE)
            if sum(entry & 0xFF for entry in entries) > 64:
                raise Abort(TOO_LONG)

        return write

    def _require_open(self, parameter: int) -> None:
        """A PDO is mapped while it is invalid only."""
        if not self._values[parameter, 1].value & _INVALID:
            raise Abort(NOT_NOW)

    def _mapped(self, mapping: int) -> list[Value]:
        entries = [self._values[mapping, k].value for k in range(1, self._values[mapping, 0].value + 1)]
        return [self._values[entry >> 16, entry >> 8 & 0xFF] for entry in entries]

    def _synced(self) -> None:
        self._syncs += 1
        if self.state != OPERATIONAL:
            return
        for k in range(_PDOS):
            identifier, every = self._values[0x1800 + k, 1].value, self._values[0x1800 + k, 2].value
            if not identifier & _INVALID and 1 <= every <= 240 and self._syncs % every == 0:
                data = b"".join(value.packed() for value in self._mapped(0x1A00 + k))
                self._send(identifier & 0x7FF, data)

    def _take_pdo(self, frame: CanFrame) -> None:
        for k in range(_PDOS):
            identifier = self._values[0x1400 + k, 1].value
            if identifier & _INVALID or identifier & 0x7FF != frame.id:
                continue
            mapped, at = self._mapped(0x1600 + k), 0
            if sum(value.size for value in mapped) > len(frame.data):
                self.emergency(0x8210)
                return
            for value in mapped:
                value.set(frame.data[at : at + value.size])
                at += value.size

    def _serve(self, request: bytes) -> None:
        command, index, sub = struct.unpack_from("<BHB", request)
        try:
            kind = command >> 5
            if kind == 2:
                self._tell(index, sub)
            elif kind == 3:
                self._tell_on(command)
            elif kind == 1 and command & 0x02:
                size = 4 - (command >> 2 & 0x03) if command & 0x01 else 4
                self._take(index, sub, request[4 : 4 + size])
                self._answer(struct.pack("<BHB4x", 0x60, index, sub))
            elif kind != 4:
                raise Abort(NO_SUCH_COMMAND)
        except Abort as refusal:
            self._answer(struct.pack("<BHBI", 0x80, index, sub, refusal.code))

    def _tell(self, index: int, sub: int) -> None:
        if (index, sub) in self._texts:
            self._text, self._toggle = self._texts[index, sub], 0
            self._answer(struct.pack("<BHBI", 0x41, index, sub, len(self._text)))
            return
        data = self._found(index, sub).packed()
        self._answer(struct.pack("<BHB4s", 0x43 | (4 - len(data)) << 2, index, sub, data))

    def _tell_on(self, command: int) -> None:
        if command & 0x10 != self._toggle:
            raise Abort(0x05030000)
        part, self._text = self._text[:7], self._text[7:]
        last = 0 if self._text else 1
        self._answer(struct.pack("<B7s", self._toggle | (7 - len(part)) << 1 | last, part))
        self._toggle ^= 0x10

    def _take(self, index: int, sub: int, data: bytes) -> None:
        value = self._found(index, sub)
        if not value.writable:
            raise Abort(READ_ONLY)
        value.set(data)

    def _found(self, index: int, sub: int) -> Value:
        if (found := self._values.get((index, sub))) is None:
            known = any(other == index for other, _ in self._values)
            raise Abort(ABSENT_SUB if known else ABSENT)
        return found

    def _answer(self, data: bytes) -> None:
        self._send(0x580 + self.number, data)

    def _send(self, identifier: int, data: bytes) -> None:
        if not self.silent:
            self._send_frame(CanFrame(identifier, data))


def _transmission(kind: int) -> None:
    if 241 <= kind <= 253:
        raise Abort(WRONG_VALUE)
