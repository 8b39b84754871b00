"""The first look at an arm, over a connection of this driver's own that only reads: does it speak as an e-series does?

The vendor's library hangs, or fails without a reason, at a controller that answers otherwise. Here each question has
its own answer in words, before anything is set or begun.
Source: the maker's RTDE guide, version 2; docs/protocols.md, section 1.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np

from drivers.arm.rtde_link import PORT, RATE_HZ, VARIABLES, VERSION, RtdeLink
from drivers.clock import Clock
from drivers.errors import NotConnectedError

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
