"""The driver's two links: the pipe to the child process, and an RTDE connection of its own for what the library lacks.

Whatever becomes of the child (crash, hang, kill), every waiting call ends at once with the same `DeviceFault`, and
the process is gone afterwards. Deadlines here are in seconds on the wall.

The RTDE connection asks first whether the arm speaks as an e-series does: the vendor's library hangs, or fails without
a reason, at a controller that answers otherwise. It also brackets the arm's clock: a register that a client writes
appears in the states, and the first state that shows it was measured after it was sent and before it came back. What
cannot be known from outside: how long the controller held the joints' angles back before it stamped them.

Source: the maker's RTDE guide, version 2; docs/reference/protocols.md, section 1.
"""

import itertools
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Self

from drivers.arm.faults import fault
from drivers.arm.feed import UNANSWERED, ChildReply, ChildRequest, ChildSetup, Ended, Lost, Snapshot
from drivers.clock import Clock, Latch
from drivers.errors import Aborted, DeadlineError, DeviceFault, NotConnectedError
from drivers.interfaces import Traffic
from drivers.last_words import Pulse
from drivers.packages import lacking

_SILENCE_S = 2.0
_LOOK_S = 0.02


class _Pending:
    def __init__(self) -> None:
        self.done = threading.Event()
        self.problem: tuple[str, str] | None = None


class ArmLink:
    """A running child process, connected to the arm. `on_snapshot` and `on_ended` are called from the link's own
    thread, and so is `on_lost`, once, when a link that was up is lost otherwise than by `close`."""

    def __init__(
        self, name: str, setup: ChildSetup, connect_deadline: float, on_snapshot: Callable[[Snapshot], None],
        on_ended: Callable[[Ended], None], on_lost: Callable[[DeviceFault], None],
        wanted: Callable[[], bool] = lambda: True,
    ) -> None:  # fmt: skip
        """Start the child and wait until it is connected; `NotConnectedError` if it is not within the deadline, or at
        once without ur-rtde. `Aborted`, with the child gone, as soon as it is not `wanted` any more."""
        if missing := lacking("rtde_control", "ur-rtde"):
            raise NotConnectedError(name, missing)
        self.lost: DeviceFault | None = None
        self._name = name
        self._address = setup.address
        self._on_snapshot, self._on_ended, self._on_lost = on_snapshot, on_ended, on_lost
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._sending = threading.Lock()
        up = _Pending()
        self._pending: dict[int, _Pending] = {0: up}
        self._closing = False
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        self._pipe, self._process = self._spawn()
        self._connected = False
        self._connect_deadline = connect_deadline
        self._reader = threading.Thread(target=self._read, name=f"{name} link", daemon=True)
        self._reader.start()
        try:
            self._transmit(setup)
            deadline = time.monotonic() + connect_deadline
            while not up.done.wait(_LOOK_S) and wanted() and time.monotonic() < deadline:
                pass
            if not wanted():
                raise Aborted(f"{name}: connecting was stopped; the process that had begun it is gone")
            reason = (up.problem or ("", ""))[1] if up.done.is_set() else f"no answer within {connect_deadline:g} s"
            if reason:
                raise NotConnectedError(
                    name,
                    f"no connection to the arm at {setup.address}: {reason}. See that it is switched on, that its "
                    "address is right, that it is in remote control and that no other program controls it.",
                )
        except BaseException:  # also Ctrl-C: the child must not go on holding the arm
            self._closing = True
            self._process.kill()
            self._end()
            raise
        self._pulse = Pulse(f"{name} pulse", self._beat) if setup.control else None

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def call(self, name: str, *arguments: object, deadline: float) -> tuple[str, str] | None:
        """Have the child do something; None, or the problem as (code, text). Raises the link's `DeviceFault` when it is
        lost, or not answered within `deadline` wall seconds: then the child hangs and is killed."""
        pending = _Pending()
        number = next(self._numbers)
        with self._lock:
            # Under the lock: whoever is not told of the loss by it will be by `_fail`, which takes all that wait.
            self._raise_if_lost()
            self._pending[number] = pending
        self._transmit(ChildRequest(number, name, arguments))
        if not pending.done.wait(deadline):
            self._fail(f"its process did not answer '{name}' within {deadline:g} s")
            self._raise_if_lost()
        if pending.problem is not None and pending.problem[0] == "arm.link_lost":
            self._raise_if_lost()
        return pending.problem

    def tell(self, name: str, *arguments: object) -> None:
        """Tell the child something that it does not answer; raises the link's `DeviceFault` when it is lost."""
        self._raise_if_lost()
        self._transmit(ChildRequest(UNANSWERED, name, arguments))
        self._raise_if_lost()

    def close(self, deadline: float) -> None:
        """Let the child stop the arm, switch the safe outputs off and end; it is killed if it does not."""
        self._closing = True
        if self._pulse is not None:
            self._pulse.close()
        pending, number = _Pending(), next(self._numbers)
        with self._lock:
            up = self.lost is None
            if up:
                self._pending[number] = pending
        if up:
            self._transmit(ChildRequest(number, "close"))
            pending.done.wait(deadline)
        self._fail("it was closed")
        self._end()

    def _beat(self) -> None:
        """A sign of life; one that cannot be sent is no fault: a child that ends by itself makes the arm safe first."""
        self._raise_if_lost()
        with self._sending:
            self._pipe.send(ChildRequest(UNANSWERED, "alive"))

    def _raise_if_lost(self) -> None:
        if self.lost is not None:
            raise self.lost

    def _spawn(self) -> tuple[Connection, subprocess.Popen[bytes]]:
        ours, theirs = socket.socketpair()
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join(path or "." for path in sys.path))
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-m", "drivers.arm.child.main", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._errors,
                env=environment,
                start_new_session=True,  # a Ctrl-C is for the supervisor, which stops the arm through this process
            )
        return Connection(ours.detach()), process

    def _transmit(self, message: ChildSetup | ChildRequest) -> None:
        try:
            with self._sending:
                self._pipe.send(message)
        except OSError:
            self._fail("its process has ended")

    def _read(self) -> None:
        try:
            while self.lost is None:
                if not self._pipe.poll(_SILENCE_S if self._connected else self._connect_deadline):
                    if self._connected:
                        self._fail(f"its process gave no sign of life for {_SILENCE_S:g} s")
                        return
                    continue
                self._route(self._pipe.recv())
        except (EOFError, OSError):
            self._fail(self._death())

    def _route(self, message: ChildReply | Snapshot | Ended | Lost) -> None:
        match message:
            case Snapshot():
                self._on_snapshot(message)
            case ChildReply():
                with self._lock:
                    pending = self._pending.pop(message.number, None)
                self._connected = self._connected or message.problem is None
                if pending is not None:
                    pending.problem = message.problem
                    pending.done.set()
            case Ended():
                self._on_ended(message)
            case Lost():
                self._fail(message.text)

    def _death(self) -> str:
        try:
            code = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            return "its process closed the pipe"
        return f"its process was ended by {signal.Signals(-code).name}" if code < 0 else f"its process ended ({code})"

    def _fail(self, reason: str) -> None:
        with self._lock:
            if self.lost is not None:
                return
            self.lost = DeviceFault(
                self._name,
                # Also where the child's end is seen before `close` goes on.
                "arm.link_closed" if self._closing else "arm.link_lost",
                f"the link to the arm at {self._address} was lost: {reason}",
                recoverable=True,
                hint="See that the arm is on and connected, then `cell recover`.",
            )
            waiting = list(self._pending.values())
            self._pending.clear()
        for pending in waiting:
            pending.problem = ("arm.link_lost", self._last_words() or reason)
            pending.done.set()
        if not self._closing:
            self._process.kill()
            # Before it was up nothing on the arm was ours: there is nothing to make safe, and others are left alone.
            if self._connected:
                self._on_lost(self.lost)

    def _last_words(self) -> str:
        """What the child wrote last before it died, for an error at the start."""
        if self._connected:
            return ""
        self._errors.seek(0)
        lines = self._errors.read().decode("utf-8", "replace").strip().splitlines()
        return lines[-1] if lines else ""

    def _end(self) -> None:
        try:
            self._process.wait(0.5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(2.0)
        if threading.current_thread() is not self._reader:
            self._reader.join(2.0)
        self._pipe.close()
        self._errors.close()


def see_safe(address: str, outputs: tuple[int, ...], deadline: float) -> bool:
    """Switch outputs of the arm off through a process of its own that needs nothing else. True once the arm itself has
    shown that they are off and that it stands, False if it did not within `deadline` s."""
    command = [sys.executable, "-m", "drivers.arm.child.main", "--safe", address, ",".join(map(str, outputs))]
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join(path or "." for path in sys.path))
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, timeout=deadline, check=False, start_new_session=True
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


PORT = 30004
VERSION, RATE_HZ = 2, 500.0
VARIABLES = (
    "timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "actual_TCP_force", "actual_digital_input_bits",
    "actual_digital_output_bits", "robot_mode", "robot_status_bits", "safety_status_bits", "runtime_state",
    "payload", "payload_cog",
)  # fmt: skip
"""What the driver reads of the arm, and the child process as well."""
STATE = struct.Struct(">B25d2Qi3I4d")
"""A packet of them, behind its recipe's number."""
_HEADER = struct.Struct(">HB")


class RtdeLink:
    """A connection to the arm at `address`; packets one at a time, all within `timeout` wall seconds of its opening.
    Raises `TimeoutError` or another `OSError`."""

    def __init__(self, address: str, clock: Clock, timeout: float, traffic: Traffic | None = None) -> None:
        self._clock = clock
        self._traffic = traffic or Traffic()
        self._deadline = clock.now() + timeout * clock.rate
        self._rest = b""
        self._socket = socket.create_connection((address, PORT), timeout=timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __enter__(self) -> Self:
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

    def wait(self, seconds: float) -> bool:
        """Whether a whole packet is here, looked for at most so long on the wall: `receive` then waits for nothing."""
        if not self._whole and select.select([self._socket], [], [], seconds)[0]:
            self._fill()
        return self._whole

    @property
    def _whole(self) -> bool:
        return len(self._rest) >= _HEADER.size and len(self._rest) >= _HEADER.unpack_from(self._rest)[0]

    def newest(self, kind: str, timeout: float) -> bytes:
        """The payload of the last packet of this kind that has come; where there is none the next, within `timeout`."""
        self._deadline = self._clock.now() + timeout * self._clock.rate
        payload = self.receive(kind)
        while self.wait(0.0):
            payload = self.receive(kind)
        return payload

    def ask(self, kind: str, payload: bytes) -> bytes:
        """The reply to a packet, which is of its kind."""
        self.send(kind, payload)
        return self.receive(kind)

    def _take(self, size: int) -> bytes:
        while len(self._rest) < size:
            left = self._clock.wall(self._deadline - self._clock.now())
            if left <= 0:
                raise TimeoutError("the arm has gone silent")
            self._socket.settimeout(left)
            self._fill()
        taken, self._rest = self._rest[:size], self._rest[size:]
        return taken

    def _fill(self) -> None:
        if not (data := self._socket.recv(65536)):
            raise ConnectionResetError("the arm closed the connection")
        self._rest += data


SIZES = {
    "BOOL": 1, "UINT8": 1, "INT32": 4, "UINT32": 4, "UINT64": 8, "DOUBLE": 8, "VECTOR3D": 24, "VECTOR6D": 48,
    "VECTOR6INT32": 24, "VECTOR6UINT32": 24,
}  # fmt: skip
PACKETS = 10
"""How many states the pace is taken from."""
SLOWEST_S = 0.0045
"""Between two states by the arm's clock, median: an e-series arm gives one every 2 ms, older ones one every 8 ms."""
_UPDATE = "Update the controller's software."


def probe(name: str, address: str, clock: Clock, timeout: float) -> None:
    """Raise `NotConnectedError`, with what is wrong and what to do, unless the arm at `address` tells its states. All
    within `timeout` wall seconds. Nothing on the arm is set, begun or ended."""

    def refuse(what: str, remedy: str) -> NotConnectedError:
        return NotConnectedError(name, f"no connection to the arm at {address}: {what}. {remedy}")

    try:
        with RtdeLink(address, clock, timeout) as link:
            _probe(link, clock, refuse)
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


def _probe(link: RtdeLink, clock: Clock, refuse: Callable[[str, str], NotConnectedError]) -> None:
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
    period = sorted(b - a for a, b in itertools.pairwise(times))[PACKETS // 2 - 1] / clock.rate
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
        if reply[:1] in (b"", b"\0") or b"NOT_FOUND" in reply or b"IN_USE" in reply:
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
