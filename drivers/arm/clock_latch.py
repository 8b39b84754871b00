"""The arm's clock between two host times: a question that the stream of states itself answers.

RTDE sends states unasked, so nothing in them tells how late they are. But a register that a client writes appears in
the states: the first that shows the number was measured after it was sent, and before it came back. All connections
tell the same clock, so this bounds the times of states that come by any of them, however late those are.

What cannot be known from outside: how long the controller held the joints' angles back before it stamped them.
Source: the maker's RTDE guide, version 2; docs/reference/protocols.md, section 1.
"""

from __future__ import annotations

import struct

from drivers.arm.faults import fault
from drivers.arm.rtde_link import PORT, RATE_HZ, VERSION, RtdeLink
from drivers.clock import Clock
from drivers.clock_map import Latch
from drivers.errors import DeadlineError, NotConnectedError
from drivers.traffic import Traffic

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
