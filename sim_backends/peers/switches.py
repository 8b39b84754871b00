"""What laser and claw hang on where it is no output of the arm: relay boards on a serial line, a gripper on a socket.

One board has a command line in text, one takes four bytes and says nothing. The gripper's program has GET and SET of
variables, in text without an end mark. Written from docs/how-to/other-makes.md, sections 2 and 3.
"""

import socket
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from sim_backends.clock import WorldClock
from sim_backends.peers.server import Peer, SerialServer, TcpServer
from sim_backends.world.world import World

COUNT = 8
VERSION, NUMBER = "00000009", "sim00001"


class RelayBoard:
    """The relays of one board. `wired` are functions that hear of a relay's changes, `lines` tell an input's level."""

    def __init__(
        self,
        wired: Mapping[int, tuple[Callable[[bool], None], Callable[[], bool]]],
        lines: Mapping[int, Callable[[], bool]],
        first: int = 0,
    ) -> None:
        """`wired` gives for a relay how what hangs on it is set, and asked; relays are counted from `first`."""
        self._wired = wired
        self._lines = lines
        self.numbers = range(first, first + COUNT)
        self._free = dict.fromkeys(self.numbers, False)

    def set(self, relay: int, on: bool) -> None:
        """Switch a relay that exists."""
        if relay in self._wired:
            self._wired[relay][0](on)
        else:
            self._free[relay] = on

    def shows(self, relay: int) -> bool:
        """Whether it is on."""
        return self._wired[relay][1]() if relay in self._wired else self._free[relay]

    def level(self, line: int) -> bool:
        """Whether an input is high; a free one is pulled up."""
        return self._lines[line]() if line in self._lines else True


class NumatoPeer(SerialServer):
    """A board with a command line: it repeats what it hears, answers, and prompts."""

    def __init__(self, board: RelayBoard, *, pty: bool = False) -> None:
        self.board = board
        super().__init__("numato", self._hear, pty=pty)

    def _hear(self, data: bytes, write: Callable[[bytes], object]) -> bytes:
        while b"\r" in data:
            line, _, data = data.partition(b"\r")
            command = line.decode("ascii", "replace").strip()
            answer = self._answer(command.split())
            write(f"{command}\n\r{answer}{chr(10) + chr(13) if answer else ''}>".encode())
        return data

    def _answer(self, words: list[str]) -> str:
        match words:
            case ["ver"]:
                return VERSION
            case ["id", "get"]:
                return NUMBER
            case ["relay", "on" | "off" as what, number] if _index(number) in self.board.numbers:
                self.board.set(_index(number), what == "on")
            case ["relay", "read", number] if _index(number) in self.board.numbers:
                return "on" if self.board.shows(_index(number)) else "off"
            case ["relay", "readall"]:
                return f"{sum(self.board.shows(number) << number for number in self.board.numbers):02x}"
            case ["gpio", "read", number] if _index(number) in range(COUNT):
                return "1" if self.board.level(_index(number)) else "0"
        return ""


def _index(text: str) -> int:
    """0 to 9, then A for 10 and so on; -1 for anything else."""
    return "0123456789ABCDEFGHIJKLMNOPQRSTUV".find(text) if len(text) == 1 else -1


class LcusPeer(SerialServer):
    """A board that switches a relay for four bytes with the right sum, and never answers."""

    def __init__(self, board: RelayBoard, *, pty: bool = False) -> None:
        self.board = board
        super().__init__("lcus", self._hear, pty=pty)

    def _hear(self, data: bytes, write: Callable[[bytes], object]) -> bytes:
        while len(data) >= 4:
            start, relay, what, total = data[:4]
            if start == 0xA0 and what in (0, 1) and total == (start + relay + what) & 0xFF:
                if relay in self.board.numbers:
                    self.board.set(relay, what == 1)
                data = data[4:]
            else:
                data = data[1:]
        return data


PART_AT = 148
"""Where the fingers stand when they hold the part."""
SLOWEST, FASTEST = 60.0, 450.0
"""Counts per second at speed 0 and at 255."""
_REACTION_S = 0.03
"""Until the fingers begin to move, and what the gripper finds becomes that of the new motion."""


@dataclass(frozen=True)
class _Way:
    begun: float
    start: float
    goal: int
    speed: float

    def at(self, t: float) -> float:
        way = max(0.0, t - self.begun) * self.speed
        return min(self.start + way, self.goal) if self.goal > self.start else max(self.start - way, self.goal)


class Gripper:
    """One gripper on the world's claw; safe between threads."""

    def __init__(self, world: World, clock: WorldClock) -> None:
        """It holds the part, or stands closed where a claw without a part does."""
        self._world = world
        self._clock = clock
        self._lock = threading.Lock()
        self.requested = 255
        self._way = _Way(0.0, PART_AT, PART_AT, 0.0)

    def go(self, position: int, speed: int) -> None:
        """Send the fingers to `position` (0 to 255) at `speed` (0 to 255)."""
        with self._lock:
            t = self._clock.now()
            here = self._at(t)
            self.requested = position
            self._world.switches["claw"] = position >= PART_AT
            rate = SLOWEST + (FASTEST - SLOWEST) * speed / 255.0
            self._way = _Way(t + _REACTION_S, here, position, rate)

    def position(self) -> int:
        """Where the fingers are now."""
        with self._lock:
            return round(self._at(self._clock.now()))

    def finding(self) -> int:
        """0 moving, 1 stopped by something while opening, 2 while closing, 3 at the requested position."""
        with self._lock:
            t = self._clock.now()
            here = self._at(t)
            if self._world.part.held and here == PART_AT and self.requested > PART_AT:
                return 2
            if t < self._way.begun or here != self.requested:
                return 0
            return 3

    def _at(self, t: float) -> float:
        if self._world.switches["claw"] and self.requested < PART_AT:
            # A person has filled the claw and closed it.
            self.requested, self._way = 255, _Way(t, PART_AT, PART_AT, 0.0)
        here = self._way.at(t)
        if self._world.part.held and self.requested >= PART_AT:
            # With a part between them they come as far as its width.
            return float(PART_AT) if self._way.start >= PART_AT else min(here, PART_AT)
        return here


CLAW_FAULTS = ("claw.overcurrent", "claw.link_lost")
WRITABLE = ("ACT", "GTO", "ATR", "ADR", "FOR", "SPE", "POS")
_OVERCURRENT = 14
_ACTIVATION_S = 1.5
"""World seconds that an activation takes."""


class RobotiqPeer(TcpServer):
    """Serves the gripper of `world` at `address` (`host:port`); active at the start."""

    def __init__(self, world: World, clock: WorldClock) -> None:
        super().__init__("robotiq", self._serve)
        self.gripper = Gripper(world, clock)
        self._clock = clock
        self._values_lock = threading.Lock()
        self._values = {"ACT": 1, "GTO": 1, "ATR": 0, "ADR": 0, "FOR": 255, "SPE": 255, "POS": 255}
        self._fault = 0
        self._active_at = 0.0

    def fault(self, name: str) -> None:
        """Cause a fault of `CLAW_FAULTS`: the gripper reports that its motor takes too much current, or all connections
        break once. ValueError for another name."""
        match name:
            case "claw.overcurrent":
                self._fault = _OVERCURRENT
            case "claw.link_lost":
                self.drop()
            case _:
                raise ValueError(f"unknown claw fault {name!r}; known: {', '.join(CLAW_FAULTS)}")

    def clear(self) -> None:
        """As a person does at the pendant: clear the fault and activate it; the fingers stay where they are."""
        self._fault = 0
        with self._values_lock:
            self._values["ACT"] = 1
            self._active_at = self._clock.now()

    def answer(self, line: str) -> str:
        """The reply to one line."""
        words = line.split()
        with self._values_lock:
            match words:
                case ["GET", name] if (value := self._read(name)) is not None:
                    return f"{name} {value}"
                case ["SET", *pairs] if pairs and len(pairs) % 2 == 0:
                    return "ack" if self._write(dict(zip(pairs[::2], pairs[1::2], strict=True))) else "?"
        return "?"

    def _read(self, name: str) -> int | None:
        if name == "STA":
            return 0 if not self._values["ACT"] else 3 if self._clock.now() >= self._active_at else 1
        if name == "OBJ":
            return self.gripper.finding() if self._values["GTO"] else 0
        if name == "POS":
            return self.gripper.position()
        if name == "PRE":
            return self.gripper.requested
        if name == "FLT":
            return self._fault
        return self._values.get(name)

    def _write(self, pairs: dict[str, str]) -> bool:
        if not all(name in WRITABLE and text.isdecimal() and int(text) <= 255 for name, text in pairs.items()):
            return False
        before = self._values["ACT"]
        self._values.update({name: int(text) for name, text in pairs.items()})
        if self._values["ACT"] and not before:
            self._fault = 0
            self._active_at = self._clock.now() + _ACTIVATION_S
        if not self._values["ACT"]:
            return True
        able = self._values["GTO"] and not self._fault and self._clock.now() >= self._active_at
        if able and ("POS" in pairs or "GTO" in pairs):
            self.gripper.go(self._values["POS"], self._values["SPE"])
        return True

    def _serve(self, connection: socket.socket) -> None:
        pending = b""
        while data := connection.recv(1024):
            pending += data
            while b"\n" in pending:
                line, _, pending = pending.partition(b"\n")
                connection.sendall(self.answer(line.decode("ascii", "replace")).encode())


BOARDS = {"numato": (NumatoPeer, 0), "lcus": (LcusPeer, 1)}
"""Relay boards: their peer, and the number of their first relay."""


def switch_peers(world: World) -> tuple[list[Peer], dict[str, dict[str, object]]]:
    """Peers for laser and claw, and their endpoints by device. Raises ValueError for a make that has none."""
    wires = {name: wire for name, wire in world.scene.drawing.cell.wires.items() if name in ("laser", "claw")}
    peers: list[Peer] = []
    endpoints: dict[str, dict[str, object]] = {}
    # Relays of one board are on one line.
    for make, place in dict.fromkeys((wire["make"], wire["place"]) for wire in wires.values()):
        on_it = {name: wire for name, wire in wires.items() if (wire["make"], wire["place"]) == (make, place)}
        if make == "robotiq":
            gripper = RobotiqPeer(world, world.clock)
            peers.append(gripper)
            endpoints |= {name: {"address": gripper.address} for name in on_it}
        elif make in BOARDS:
            kind, first = BOARDS[make]
            wired = {
                wire["relay"]: (partial(world.switch, name), partial(world.switches.__getitem__, name))
                for name, wire in on_it.items()
            }
            lines: dict[int, Callable[[], bool]] = {
                wire["feedback"]: partial(_grip, world, wire["active_high"])
                for wire in on_it.values()
                if "feedback" in wire
            }
            board = kind(RelayBoard(wired, lines, first))
            peers.append(board)
            endpoints |= {name: {"url": board.url} for name in on_it}
        else:
            raise ValueError(f"nothing simulates a switch of the make {make!r}")
    return peers, endpoints


def _grip(world: World, active_high: bool) -> bool:
    return world.part.held == active_high
