"""The driver's end of the pipe to the child process: requests with deadlines, and one clear fault when it is lost.

Whatever becomes of the child (crash, hang, kill), every waiting call ends at once with the same `DeviceFault`, and
the process is gone afterwards. Deadlines here are in seconds on the wall: pipes do not run faster in a simulation.
"""

from __future__ import annotations

import itertools
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

from drivers.arm.feed import UNANSWERED, ChildReply, ChildRequest, ChildSetup, Ended, Lost, Snapshot
from drivers.errors import Aborted, DeviceFault, NotConnectedError
from drivers.packages import lacking
from drivers.pulse import Pulse

_SILENCE_S = 2.0
_LOOK_S = 0.02


class _Pending:
    def __init__(self) -> None:
        self.done = threading.Event()
        self.problem: tuple[str, str] | None = None


class ArmLink:
    """A running child process, connected to the arm.

    `on_snapshot` and `on_ended` are called from the link's own thread, and so is `on_lost`, once, when a link that was
    up is lost otherwise than by `close`.
    """

    def __init__(
        self,
        name: str,
        setup: ChildSetup,
        connect_deadline: float,
        on_snapshot: Callable[[Snapshot], None],
        on_ended: Callable[[Ended], None],
        on_lost: Callable[[DeviceFault], None],
        wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        """Start the child and wait until it is connected; `NotConnectedError` if it is not within the deadline,
        or at once without ur-rtde.

        `Aborted`, with the child gone, as soon as it is not `wanted` any more.
        """
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
        self._transmit(setup)
        deadline = time.monotonic() + connect_deadline
        while not up.done.wait(_LOOK_S) and wanted() and time.monotonic() < deadline:
            pass
        reason = f"no answer within {connect_deadline:g} s" if not up.done.is_set() else (up.problem or ("", ""))[1]
        if reason or not wanted():
            self._closing = True
            self._process.kill()
            self._end()
            if not wanted():
                raise Aborted(f"{name}: connecting was stopped; the process that had begun it is gone")
            raise NotConnectedError(
                name,
                f"no connection to the arm at {setup.address}: {reason}. See that it is switched on, that its address "
                "is right, that it is in remote control and that no other program controls it.",
            )
        self._pulse = Pulse(f"{name} pulse", self._beat) if setup.control else None

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def call(self, name: str, *arguments: object, deadline: float) -> tuple[str, str] | None:
        """Have the child do something; None, or the problem as (code, text).

        Raises the link's `DeviceFault` when it is lost, or not answered within `deadline` wall seconds: then the child
        hangs and is killed.
        """
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

    # --- inside ---

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
    """Switch outputs of the arm off through a process of its own that needs nothing else.

    True once the arm itself has shown that they are off and that it stands, False if it did not within `deadline` s.
    """
    command = [sys.executable, "-m", "drivers.arm.child.main", "--safe", address, ",".join(map(str, outputs))]
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join(path or "." for path in sys.path))
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, timeout=deadline, check=False, start_new_session=True
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0
