"""One RTDE connection of this process' own, beside that of the vendor's library, for what that does not offer.

`look` is the first use of it: does the arm speak as an e-series does? The vendor's library hangs, or fails without a
reason, at a controller that answers otherwise. Here each question has its own answer in words.

Source: the maker's RTDE guide, version 2; docs/reference/protocols.md, section 1.

The arm's clock between two host times: a question that the stream of states itself answers.

RTDE sends states unasked, so nothing in them tells how late they are. But a register that a client writes appears in
the states: the first that shows the number was measured after it was sent, and before it came back. All connections
tell the same clock, so this bounds the times of states that come by any of them, however late those are.

What cannot be known from outside: how long the controller held the joints' angles back before it stamped them.
Source: the maker's RTDE guide, version 2; docs/reference/protocols.md, section 1."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable

import numpy as np

from drivers.arm.faults import fault
from drivers.clock import Clock, Latch
from drivers.errors import DeadlineError, NotConnectedError
from drivers.traffic import Traffic

PORT = 30004
VERSION, RATE_HZ = 2, 500.0
VARIABLES = (
    "timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "actual_TCP_force", "actual_digital_input_bits",
    "actual_digital_output_bits", "robot_mode", "robot_status_bits", "safety_status_bits", "runtime_state",
    "payload", "payload_cog",
)  # fmt: skip
"""What the driver reads of the arm. Here, since the child process reads them too and starts without `numpy`."""
_HEADER = struct.Struct(">HB")


class RtdeLink:
    """A connection to the arm at `address`; packets one at a time, all within `timeout` wall seconds of its opening.

    Raises `TimeoutError` or another `OSError`.
    """

    def __init__(self, address: str, clock: Clock, timeout: float, traffic: Traffic | None = None) -> None:
        self._clock = clock
        self._traffic = traffic or Traffic()
        self._deadline = clock.now() + timeout * clock.rate
        self._rest = b""
        self._socket = socket.create_connection((address, PORT), timeout=timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __enter__(self) -> RtdeLink:
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()

    def send(self, kind: str, payload: bytes) -> None:
        """One packet to the controller."""
        packet = _HEADER.pack(_HEADER.size + len(payload), ord(kind)) + payload
        self._socket.sendall(packet)
        self._traffic.sent(packet)

    def receive(self, kind: str) -> bytes:
        """The payload of the next packet of this kind; others are passed over."""
        while True:
            head = self._take(_HEADER.size)
            size, got = _HEADER.unpack(head)
            if size < _HEADER.size:
                raise ConnectionAbortedError(f"a packet of {size} bytes came, which is none of RTDE")
            payload = self._take(size - _HEADER.size)
            self._traffic.received(head + payload)
            if chr(got) == kind:
                return payload

    def ask(self, kind: str, payload: bytes) -> bytes:
        """The reply to a packet, which is of its kind."""
        self.send(kind, payload)
        return self.receive(kind)

    def _take(self, size: int) -> bytes:
        while len(self._rest) < size:
            left = self._clock.wall(self._deadline - self._clock.now())
            if left <= 0:
                raise TimeoutError
            self._socket.settimeout(left)
            data = self._socket.recv(65536)
            if not data:
                raise ConnectionResetError("the arm closed the connection")
            self._rest += data
        taken, self._rest = self._rest[:size], self._rest[size:]
        return taken


SIZES = {
    "BOOL": 1, "UINT8": 1, "INT32": 4, "UINT32": 4, "UINT64": 8, "DOUBLE": 8, "VECTOR3D": 24, "VECTOR6D": 48,
    "VECTOR6INT32": 24, "VECTOR6UINT32": 24,
}  # fmt: skip
PACKETS = 10
"""How many states the pace is taken from."""
SLOWEST_S = 0.0045
"""Between two states by the arm's clock, median: an e-series arm gives one every 2 ms, older ones one every 8 ms."""
_UPDATE = "Update the controller's software."


def look(name: str, address: str, clock: Clock, timeout: float) -> None:
    """Raise `NotConnectedError`, with what is wrong and what to do, unless the arm at `address` tells its states.

    All within `timeout` wall seconds. Nothing on the arm is set, begun or ended.
    """

    def refuse(what: str, remedy: str) -> NotConnectedError:
        return NotConnectedError(name, f"no connection to the arm at {address}: {what}. {remedy}")

    try:
        with RtdeLink(address, clock, timeout) as link:
            _look(link, clock, refuse)
    except TimeoutError as error:
        raise refuse(
            f"no answer within {timeout:g} s",
            "See that it is switched on, that its address is right, and that nothing between holds its packets back.",
        ) from error
    except OSError as error:
        raise refuse(
            f"port {PORT}: {error}",
            "See that it is switched on and that its address is right, that RTDE is enabled (Settings, Security, "
            "Services) and that it is an arm of the e-series.",
        ) from error


def _look(link: RtdeLink, clock: Clock, refuse: Callable[[str, str], NotConnectedError]) -> None:
    if not _yes(link.ask("V", struct.pack(">H", VERSION))):
        raise refuse(f"its RTDE does not speak version {VERSION}", _UPDATE)
    reply = link.ask("O", struct.pack(">d", RATE_HZ) + ",".join(VARIABLES).encode())
    types = reply[1:].decode("ascii", "replace").split(",")
    if not _yes(reply) or len(types) != len(VARIABLES):
        raise refuse(
            f"asked for {len(VARIABLES)} variables it answers {reply[:60]!r}",
            "End other programs that read its states.",
        )
    if missing := [variable for variable, kind in zip(VARIABLES, types, strict=True) if kind not in SIZES]:
        raise refuse(f"its states have no {', '.join(missing)}", _UPDATE)
    if not _yes(link.ask("S", b"")):
        raise refuse("it does not begin to send its states", "End other programs that read its states.")
    length = 1 + sum(SIZES[kind] for kind in types)
    times = []
    for _ in range(PACKETS):
        packet = link.receive("U")
        if len(packet) != length:
            raise refuse(f"a state of {len(packet)} bytes came, {length} were agreed", _UPDATE)
        times.append(struct.unpack_from(">d", packet, 1)[0])
    period = float(np.median(np.diff(times))) / clock.rate
    if not 0.0 < period <= SLOWEST_S:
        raise refuse(
            f"it tells its state every {1e3 * period:.1f} ms",
            f"This driver is for arms that do every 2 ms (the e-series, PolyScope 5), at most {1e3 * SLOWEST_S:g} ms; "
            "older ones cannot be streamed to so.",
        )


def _yes(reply: bytes) -> bool:
    """Whether a reply's first byte, accepted or the recipe's number, is there and not 0."""
    return reply[:1] not in (b"", b"\0")


_REGISTER = "input_int_register_47"
"""The last of those that are left to clients like this one; ur-rtde uses the first 24."""
_PERIOD_S = 0.002
_QUESTIONS, _LONG_S, _TIMEOUT_S = 20, 0.3, 3.0
"""So many are asked, unless that takes longer than `_LONG_S` on the wall; all has to end within `_TIMEOUT_S`."""
_STATE, _NUMBER = struct.Struct(">Bdi"), struct.Struct(">Bi")


def latch_clock(name: str, address: str, clock: Clock, traffic: Traffic | None = None) -> Latch:
    """The shortest of several round trips, host times in s of `clock`, the arm's in s of its own.

    `DeadlineError` or `NotConnectedError` without an answer, `DeviceFault` (arm.refused) when another program holds the
    register; `name` is the arm's in them.
    """
    try:
        with RtdeLink(address, clock, _TIMEOUT_S, traffic) as link:
            return _shortest(name, link, clock)
    except TimeoutError as error:
        raise DeadlineError(name, f"no answer within {_TIMEOUT_S:g} s when its clock was asked for") from error
    except OSError as error:
        raise NotConnectedError(
            name, f"its clock cannot be read at {address}:{PORT}: {error}. See that the arm is on and connected."
        ) from error


def _shortest(name: str, link: RtdeLink, clock: Clock) -> Latch:
    states = struct.pack(">d", RATE_HZ) + f"timestamp,{_REGISTER}".encode()
    for what, kind, payload in (
        ("RTDE version 2", "V", struct.pack(">H", VERSION)),
        (f"{_REGISTER} in its states", "O", states),
        (f"a value for {_REGISTER}; end the program that holds it", "I", _REGISTER.encode()),
        ("a start of its states", "S", b""),
    ):
        reply = link.ask(kind, payload)
        if reply[:1] in (b"", b"\0"):
            raise fault(name, "arm.refused", f"it does not give {what}")
        if kind == "I":
            recipe = reply[0]
    begun = clock.now()
    _, _, number = _STATE.unpack(link.receive("U"))
    latches: list[Latch] = []
    while not latches or (len(latches) < _QUESTIONS and clock.wall(clock.now() - begun) < _LONG_S):
        # At another moment of the controller's cycle each time: asked right before it looks, it answers at once.
        clock.sleep(_PERIOD_S * clock.rate * len(latches) / _QUESTIONS)
        number = (number + 1) & 0x7FFFFFFF
        before = clock.now()
        link.send("U", _NUMBER.pack(recipe, number))
        shown, device = -1, 0.0
        while shown != number:
            _, device, shown = _STATE.unpack(link.receive("U"))
        latches.append(Latch(before, device, clock.now()))
    return min(latches, key=lambda latch: latch.bound)
