"""A Robotiq gripper (2F-85, 2F-140, Hand-E) on the socket that its program opens on the arm's controller.

That something is held is the gripper's own finding: its fingers were stopped before the position that they were sent
to. Which side they were stopped on has to fit the way in which the part is gripped. Fingers that come to the end of
their way hold nothing, whatever was commanded.

The text protocol of a Robotiq gripper: variables that are read with GET and written with SET, over one TCP socket.

Replies have no end mark: `ack` for a SET, `NAME value` for a GET. All of what the gripper knows is in the gripper, so a
connection that was lost is simply made again by the next request. Source: docs/how-to/other-makes.md, section 3."""

import re
import socket
import threading
import time
from collections.abc import Mapping

from drivers.claw.make import RobotiqClawConfig
from drivers.clock import Clock, timeout_of
from drivers.errors import UNTOLD, DeadlineError, DeviceFault, InterlockError, NotConnectedError
from drivers.interfaces import Identity, LinkStatistics, Reading
from drivers.ports import forget_unasked

REPLY_TIMEOUT_S = 1.0
"""Wall seconds for a reply: the controller's program that serves the socket asks the gripper every 8 ms or so."""
_QUIET_S = 0.002
"""Wall seconds after which a reply without an end mark is whole: it is sent at once, but may come in two pieces."""
_ATTEMPTS = 2
_ACK = re.compile(rb"ack\s*")


class BadClawReply(Exception):
    """What came is no reply to what was asked."""


class RobotiqLink:
    """The connection to `address` ("HOST:PORT") of the device `name`; `NotConnectedError` when nobody takes it."""

    def __init__(self, name: str, address: str, statistics: LinkStatistics) -> None:
        self.name = name
        self.address = address
        self._statistics = statistics
        self._lock = threading.Lock()
        self._closed = False
        self._socket: socket.socket | None = self._connected()

    def get(self, variable: str) -> int:
        """Read a variable."""
        wanted = re.compile(rb"\s*" + variable.encode() + rb"\s+(-?\d{1,9})\s*")

        def value(data: bytes) -> int:
            if (found := wanted.fullmatch(data)) is None:
                raise BadClawReply(f"{data!r} came")
            return int(found[1])

        return value(self._ask(f"GET {variable}\n".encode(), wanted))

    def set(self, values: Mapping[str, int]) -> None:
        """Write variables, all of them at once."""
        words = " ".join(f"{name} {value}" for name, value in values.items())
        self._ask(f"SET {words}\n".encode(), _ACK)

    def close(self) -> None:
        """Close the connection; every later request raises `NotConnectedError`. Idempotent."""
        with self._lock:
            self._closed = True
            self._hang_up()

    def _ask(self, request: bytes, reply: re.Pattern[bytes]) -> bytes:
        """Send `request` and give what `reply` matches. All requests mean the same when they are heard twice."""
        problem = ""
        for attempt in range(_ATTEMPTS):
            if attempt:
                self._statistics.count("retries")
            with self._lock:
                if self._closed:
                    raise NotConnectedError(self.name, "was closed. Open it again")
                if self._socket is None:
                    self._socket = self._connected()
                before = time.monotonic()
                try:
                    data = self._exchange(self._socket, request, reply)
                    self._statistics.traffic.received(data)
                except TimeoutError:
                    # A late reply would answer the next request: it dies with this connection.
                    self._statistics.count("timeouts")
                    self._hang_up()
                    problem = f"nothing came within {REPLY_TIMEOUT_S:g} s"
                    continue
                except OSError as error:
                    self._statistics.count("link_lost")
                    self._hang_up()
                    raise DeviceFault(
                        self.name,
                        "claw.link_lost",
                        f"the connection to {self.address} failed: {error}; the claw stays as it is",
                        recoverable=True,
                        hint="See that the arm's controller is on and that its Robotiq program (URCap) runs.",
                    ) from error
            if reply.fullmatch(data):
                self._statistics.add_round_trip(time.monotonic() - before)
                return data
            self._statistics.count("bad_replies")
            problem = f"{data!r} came"
        raise DeadlineError(
            self.name,
            f"no valid reply to {request!r}, {_ATTEMPTS} attempts ({problem}). Check that {self.address} is the "
            "gripper's port (63352 of the arm's controller) and that a gripper is connected there",
        )

    def _exchange(self, link: socket.socket, request: bytes, reply: re.Pattern[bytes]) -> bytes:
        forget_unasked(link)
        link.settimeout(REPLY_TIMEOUT_S)
        link.sendall(request)
        self._statistics.traffic.sent(request)
        data = b""
        until = time.monotonic() + REPLY_TIMEOUT_S
        while True:
            whole = bool(reply.fullmatch(data))
            if data.endswith(b"\n"):
                return data
            link.settimeout(_QUIET_S if whole else max(0.001, until - time.monotonic()))
            try:
                chunk = link.recv(4096)
            except TimeoutError:
                if whole or data:
                    return data
                raise
            if time.monotonic() > until:
                raise TimeoutError
            if not chunk:
                raise ConnectionResetError("it was closed by the other side")
            data += chunk

    def _connected(self) -> socket.socket:
        host, _, port = self.address.rpartition(":")
        try:
            link = socket.create_connection((host, int(port)), timeout=REPLY_TIMEOUT_S)
        except OSError as error:
            raise NotConnectedError(
                self.name,
                f"{self.address} takes no connection: {error}. Check the address and that the arm's controller is on "
                "with the gripper's program (URCap) installed",
            ) from error
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return link

    def _hang_up(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None


ACTIVE = 3
"""STA of a gripper that is activated and knows its fingers' way."""
MOVING, STOPPED_OPENING, STOPPED_CLOSING, AT_POSITION = range(4)
"""OBJ: what the gripper finds about an object."""
SAME = 4
"""Counts of POS by which fingers that have arrived may be off: they stop a little before."""
STANDS_S = 0.2
"""So long the fingers have to stand before it is believed that something stopped them."""
_POLL_S = 0.02
_FAULTS = {
    5: "its action is delayed until it is activated anew",
    7: "it has to be activated before it moves",
    8: "it is too hot, above 85 °C",
    9: "it has heard nothing for 1 s",
    10: "its supply is too low",
    11: "its automatic release goes on",
    12: "it found a fault in itself",
    13: "its activation failed",
    14: "its motor takes too much current",
    15: "its automatic release has ended",
}


class RobotiqClaw:
    """The gripper that `record` describes, which somebody has activated.

    It is never activated from here: that drives its fingers all the way to and fro, with or without a part.
    Raises `NotConnectedError` and `DeadlineError` when no gripper answers.
    """

    def __init__(self, name: str, record: RobotiqClawConfig, *, clock: Clock, control: bool = True) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self._grip = record
        self._held = STOPPED_OPENING if record.inside else STOPPED_CLOSING
        """OBJ of fingers that hold the part."""
        self._clock = clock
        self._control = control
        self._link = RobotiqLink(name, record.address, self.statistics)
        try:
            self._link.get("STA")
        except BaseException:
            self._link.close()
            raise

    def identity(self) -> Identity:
        """The gripper tells neither model nor serial number on this socket."""
        self._link.get("STA")
        return Identity("Robotiq gripper", UNTOLD, UNTOLD, self._link.address)

    def ping(self) -> float:
        """Read its status once; returns the round trip in wall seconds."""
        self._link.get("STA")
        return self.statistics.round_trips_s[-1]

    def examine(self, seconds: float) -> list[Reading]:
        """Whether it is active, and its fault."""
        active, fault = self._link.get("STA"), self._link.get("FLT")
        return [
            Reading(
                "status", float(active), "", least=ACTIVE, most=ACTIVE,
                remedy="Activate the gripper at the pendant (Robotiq's toolbar); keep clear, its fingers move.",
            ),
            Reading("fault", float(fault), "", most=0.0, remedy=f"{_fault_text(fault)}: see the gripper's manual."),
        ]  # fmt: skip

    def grip(self, timeout: float = 2.0) -> None:
        """Close; `DeviceFault` (claw.no_part) unless the fingers are stopped by a part within `timeout` s."""
        found = self._move(self._grip.closed_at, timeout)
        if found == self._held:
            return
        self._require_well()
        why = {AT_POSITION: "the fingers went all the way and met nothing", MOVING: "the fingers still move"}.get(
            found, "the fingers were stopped on the wrong side"
        )
        raise DeviceFault(
            self.name,
            "claw.no_part",
            f"closed, but after {timeout:.3g} s no part is held: {why} (OBJ {found}, POS {self._link.get('POS')})",
            recoverable=True,
            hint="See that the part lies between the fingers and that they may close farther than it is wide "
            "(claw.closed_at), then grip again.",
        )

    def release(self, timeout: float = 2.0) -> None:
        """Open; `DeviceFault` (claw.stuck) unless the fingers come to their open position within `timeout` s."""
        found = self._move(self._grip.open_at, timeout)
        if found == AT_POSITION:
            return
        self._require_well()
        raise DeviceFault(
            self.name,
            "claw.stuck",
            f"opened, but after {timeout:.3g} s the fingers are at {self._link.get('POS')} instead of "
            f"{self._grip.open_at} (OBJ {found})",
            recoverable=True,
            hint="See whether something stops the fingers; the arm must not retreat before the part is free.",
        )

    @property
    def holding(self) -> bool:
        """Whether the gripper finds a part between its fingers now. Raises `DeviceFault` when it cannot know."""
        found = self._link.get("OBJ")
        self._require_well()
        return found == self._held and self._link.get("PRE") == self._grip.closed_at

    def stop(self) -> None:
        """Nothing to stop: the claw stays as it is, because opening would drop the part."""

    def close(self) -> None:
        """Leave the claw as it is, and end the connection."""
        self._link.close()

    def _move(self, position: int, timeout: float) -> int:
        """Send the fingers there; what the gripper finds (OBJ) at their end, or when `timeout` s are over."""
        if not self._control:
            raise InterlockError(self.name, "was opened to be looked at only; nothing was sent. Open it for control")
        self._require_well()
        grip = self._grip
        self._link.set({"POS": position, "SPE": grip.speed, "FOR": grip.force, "GTO": 1})
        now = self._clock.now()
        until, since = now + timeout_of(self._clock, timeout), now
        before = (MOVING, -1)
        while True:
            taken = self._link.get("PRE") == position
            seen = found, at = self._link.get("OBJ"), self._link.get("POS")
            now = self._clock.now()
            if seen != before:
                before, since = seen, now
            if taken and found == AT_POSITION and abs(at - position) <= SAME:
                return found
            # A finding may still be that of the motion before: fingers that are stopped stay where they are.
            if taken and found in (STOPPED_OPENING, STOPPED_CLOSING) and now - since >= STANDS_S:
                return found
            if now >= until:
                return MOVING
            self._clock.sleep(_POLL_S)

    def _require_well(self) -> None:
        """Raise `DeviceFault`: claw.fault when the gripper reports one, claw.not_active when it is not activated."""
        fault = self._link.get("FLT")
        if fault:
            raise DeviceFault(
                self.name,
                "claw.fault",
                f"the gripper reports fault {fault}: {_fault_text(fault)}",
                recoverable=False,
                hint="Take the part out by hand if it is held, clear the fault at the pendant, then activate it anew.",
            )
        if (status := self._link.get("STA")) != ACTIVE:
            raise DeviceFault(
                self.name,
                "claw.not_active",
                f"the gripper is not activated (STA {status}, {ACTIVE} is active)",
                recoverable=False,
                hint="Take the part out of it and keep clear, then activate it at the pendant: its fingers go all the "
                "way to and fro.",
            )


def _fault_text(fault: int) -> str:
    return _FAULTS.get(fault & 0x0F, "one that this driver does not know") if fault else "none"
