"""Child side: the process in which ur-rtde lives, since it can crash or hang (docs/reference/protocols.md, section 7).

It ends by itself, with the motion stopped and the safe outputs off, as soon as its owner is gone (the pipe ends, or
another parent has taken over), and at once when the arm is gone. Run by the driver; with `--safe ADDRESS 0,3` it only
switches outputs off and sees that the arm stands.

Child side: what goes to the owner, sent by a thread of its own.

An owner that computes may not read for a second, and its pipe fills: neither the thread that reads the arm nor the one
that commands it may wait for that, or the controller's watchdog ends the program of an arm that is perfectly well.
"""

import math
import os
import queue
import resource
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import NoReturn

from rtde_control import RTDEControlInterface

from drivers.arm.child.control import ControlThread
from drivers.arm.child.outputs import OFF_S, SILENCE_S, Packets, keep_low, make_safe
from drivers.arm.child.program import PERIOD
from drivers.arm.dashboard import Dashboard
from drivers.arm.feed import (
    MODE_RUNNING,
    UNANSWERED,
    ChildReply,
    ChildRequest,
    ChildSetup,
    Ended,
    Lost,
    Snapshot,
    safety_code,
)
from drivers.clock import Clock
from drivers.errors import DeviceError
from drivers.last_words_child import FROZEN_S, LOOK_S, Owner, raise_priority

Message = ChildReply | Ended | Snapshot | Lost


class ChildOutbox:
    """Sends messages in the order in which they were put; `on_gone` is called once when nobody takes them any more."""

    def __init__(self, pipe: Connection, on_gone: Callable[[], None]) -> None:
        self._pipe = pipe
        self._on_gone = on_gone
        self._messages: queue.SimpleQueue[Message | threading.Event] = queue.SimpleQueue()
        threading.Thread(target=self._run, name="outbox", daemon=True).start()

    def put(self, *messages: Message) -> None:
        """Have messages sent; never waits."""
        for message in messages:
            self._messages.put(message)

    def drain(self, seconds: float) -> None:
        """Wait until what was put so far is sent, at most `seconds` on the wall."""
        sent = threading.Event()
        self._messages.put(sent)
        sent.wait(seconds)

    def _run(self) -> None:
        gone = False
        while True:
            message = self._messages.get()
            if isinstance(message, threading.Event):
                message.set()
            elif not gone:
                try:
                    self._pipe.send(message)
                except OSError:
                    gone = True
                    self._on_gone()


_CONSTRUCTION_S = 15.0
_SHUT_DOWN_S = 5.0
_PUSHES_PER_S = 125.0
_LAST_WORDS_S = 0.5
_SLACK_NS = 500_000


class Child:
    """Connects to the arm and serves the owner at the other end of `pipe`."""

    def __init__(self, pipe: Connection, setup: ChildSetup) -> None:
        self._pipe = pipe
        self._setup = setup
        self._safe_off = setup.safe_off
        self._parent = os.getppid()
        self._owner, self._ending = Owner(self._parent), False
        self._clock = Clock()
        with _ends_by_itself(_CONSTRUCTION_S):
            self._packets = Packets(setup.address, setup.control)
            self._snapshot = self._packets.read()
            control = self._take_control() if setup.control else None
        # Nobody listens: the same as the end of the pipe, which the main thread may not have seen yet.
        self._outbox = ChildOutbox(pipe, lambda: os.kill(os.getpid(), signal.SIGTERM))
        self._attended_until, self._silence = math.inf, 0.0
        self._control = ControlThread(setup, control, lambda: self._snapshot, self._send, self._lose)
        threading.Thread(target=self._watch_arm, name="arm state", daemon=True).start()

    def _take_control(self) -> RTDEControlInterface | None:
        """The control interface, or None while the arm is not ready for one: its state is still served. An arm that
        another client holds refuses here, before anything on it has been changed."""
        address = self._setup.address
        ready = not safety_code(self._snapshot.safety_bits) and self._snapshot.mode == MODE_RUNNING
        with _unhurried():
            control = RTDEControlInterface(address) if ready else None
        try:
            self._outputs_off()
            keep_low(address, self._setup.safe_off)
            if control is not None:
                self._see_running()
                _prepare(control, self._setup)
        except (RuntimeError, OSError):
            if control is not None:
                control.stopScript()
            raise
        self._snapshot = self._packets.read()
        return control

    def _see_running(self) -> None:
        """The state comes over a connection of its own, and may be older than the program's start."""
        deadline = time.monotonic() + OFF_S
        while not self._packets.read().program_running and time.monotonic() < deadline:
            self._clock.sleep(PERIOD)

    def _outputs_off(self) -> None:
        mask = sum(1 << index for index in self._safe_off)
        self._switch_off()
        deadline = time.monotonic() + OFF_S
        while self._packets.read().outputs & mask:
            if time.monotonic() > deadline:
                raise RuntimeError(f"outputs {self._safe_off} cannot be switched off")
            self._clock.sleep(PERIOD)

    def _switch_off(self) -> None:
        """As well as it can be told: on a connection that is gone the controller's own setting does it."""
        for index in self._safe_off:
            with suppress(OSError):
                self._packets.switch(index, False)

    def serve(self) -> None:
        """Obey the owner until it asks for the end or is gone, then end the process."""
        self._send(self._snapshot)
        self._send(ChildReply(0))
        closing = 0
        with suppress(EOFError, OSError):
            while True:
                request: ChildRequest = self._pipe.recv()
                if request.name == "close":
                    closing = request.number
                    break
                if request.name == "output":
                    self._send(ChildReply(request.number, self._switch(*request.arguments)))
                elif request.name == "safe_off":
                    self._send(ChildReply(request.number, self._go_off_in_the_end(*request.arguments)))
                elif request.name == "alive":
                    self._owner.beat()
                elif request.name == "attend":
                    # The time first: with the silence alone the watch would look at one that is long past.
                    self._attended_until = time.monotonic() + request.arguments[0]
                    self._silence = request.arguments[0]
                else:
                    self._control.submit(request)
        self.shut_down(closing)

    def _switch(self, index: int, value: bool) -> tuple[str, str] | None:
        try:
            self._packets.switch(index, value)
        except OSError as error:
            return "arm.refused", f"the controller did not accept a value for output {index}: {error}"
        return None

    def _go_off_in_the_end(self, outputs: tuple[int, ...]) -> tuple[str, str] | None:
        """From now on these go off when the owner is lost, and no others."""
        freed = tuple(index for index in self._safe_off if index not in outputs)
        # Both until the controller knows: one too many does no harm.
        self._safe_off = (*outputs, *freed)
        try:
            keep_low(self._setup.address, outputs, freed)
        except (RuntimeError, OSError) as error:
            return "arm.refused", f"the controller did not take which outputs it keeps low: {error}"
        self._safe_off = outputs
        return None

    def shut_down(self, closing: int = 0) -> None:
        """Outputs off, motion stopped, then the end; bounded in time whatever the arm does."""
        signal.setitimer(signal.ITIMER_REAL, _SHUT_DOWN_S)
        self._ending = True
        if self._setup.control:
            self._leave_safe()
        if closing:
            self._send(ChildReply(closing))
            self._outbox.drain(_LAST_WORDS_S)
        # The destructors of ur-rtde may hang or abort: the kernel closes the sockets.
        os._exit(0)

    def _leave_safe(self) -> None:
        self._control.submit(ChildRequest(0, "close"))
        self._switch_off()
        if not self._control.finished.wait(3.0):
            with suppress(DeviceError):
                Dashboard("arm", self._setup.address).ask("stop")
        mask = sum(1 << index for index in self._safe_off)
        for _ in range(250):
            if not self._snapshot.outputs & mask:
                break
            self._clock.sleep(PERIOD)

    def _watch_arm(self) -> None:
        every = max(1, round(1.0 / (PERIOD * _PUSHES_PER_S * self._setup.rate)))
        count = 0
        look = time.monotonic()
        while True:
            before, snapshot = self._snapshot, self._next_state()
            if time.monotonic() > look:
                look = time.monotonic() + LOOK_S
                if self._owner.frozen() and not self._ending:
                    self._stand_in()
            # Read once: the owner may say that nothing is attended any more meanwhile.
            silence = self._silence
            if silence > 0 and time.monotonic() > self._attended_until:
                # Again and again: an owner that hung may begin a motion afterwards.
                self._attended_until = time.monotonic() + silence
                self._control.submit(ChildRequest(UNANSWERED, "stop"))
            if os.getppid() != self._parent:
                os.kill(os.getpid(), signal.SIGTERM)
                self._parent = os.getppid()
            if snapshot is None:
                if time.monotonic() - before.stamp > SILENCE_S:
                    self._lose(f"no packet from the arm for {SILENCE_S:g} s")
                continue
            # A stop for safety keeps what was late before it.
            late = before.late if safety_code(snapshot.safety_bits) and before.late else self._control.late
            snapshot = self._snapshot = replace(snapshot, late=late)
            count += 1
            if count % every == 0 or _urgent(snapshot) != _urgent(before):
                self._send(snapshot)

    def _next_state(self) -> Snapshot | None:
        """The newest state that has come, or comes within `LOOK_S`; None where none does."""
        try:
            return self._packets.read() if self._packets.wait(LOOK_S) else None
        except OSError as error:
            self._lose(str(error))

    def _stand_in(self) -> None:
        """Stop the arm and switch the safe outputs off for an owner that is frozen; again if that goes on."""
        self._control.stop_because("arm.owner_frozen", f"for more than {FROZEN_S:g} s")
        self._switch_off()
        self._owner.beat()

    def _lose(self, text: str) -> NoReturn:
        self._send(Lost(text))
        self._outbox.drain(_LAST_WORDS_S)
        os._exit(3)

    def _send(self, message: Message) -> None:
        if isinstance(message, Ended):
            # The owner must not see a state from before the end of a motion that it knows to have ended.
            self._outbox.put(self._snapshot)
        self._outbox.put(message)


def _prepare(control: RTDEControlInterface, setup: ChildSetup) -> None:
    mass, centre = setup.payload
    steps: list[tuple[str, Callable[[], bool]]] = [
        ("the zero tool centre point", lambda: control.setTcp([0.0] * 6)),
        ("the payload", lambda: control.setPayload(mass, list(centre))),
        ("the watchdog", lambda: control.setWatchdog(1.0 / setup.watchdog)),
    ]
    for what, act in steps:
        if not act():
            raise RuntimeError(f"the controller did not accept {what}")


def _urgent(snapshot: Snapshot) -> tuple[int, int, int, int, int]:
    return snapshot.safety_bits, snapshot.mode, snapshot.runtime, snapshot.inputs, snapshot.outputs


@contextmanager
def _ends_by_itself(seconds: float) -> Iterator[None]:
    """Inside this context the process is killed after `seconds`: a constructor that hangs lets no thread run."""
    signal.setitimer(signal.ITIMER_REAL, seconds)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0.0)


@contextmanager
def _unhurried() -> Iterator[None]:
    """Threads that begin inside this context wake up to `_SLACK_NS` late, and not in real time. ur-rtde's looks 10 000
    times a second whether a packet has come; it comes every 2 ms."""
    slack = Path("/proc/self/timerslack_ns")
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        slack.write_text(str(_SLACK_NS))
        os.setpriority(os.PRIO_PROCESS, 0, -10)
    try:
        yield
    finally:
        with suppress(OSError):
            slack.write_text("0")  # the usual one
        raise_priority()


def _serve(descriptor: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.setswitchinterval(0.0005)
    raise_priority()
    end = socket.socket(fileno=descriptor)
    twin = end.dup()

    def hang_up(number: int, frame: FrameType | None) -> None:
        # The same as the end of the owner, and as often as it comes: an exception would end this process half-way.
        with suppress(OSError):
            twin.shutdown(socket.SHUT_RD)

    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, hang_up)
    # An owner that is frozen reads nothing: a full pipe must not hold up the child for ever.
    end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", 2, 0))
    pipe = Connection(end.detach())
    try:
        setup: ChildSetup = pipe.recv()
        child = Child(pipe, setup)
    except (RuntimeError, ValueError, EOFError, OSError) as error:
        with suppress(OSError):
            pipe.send(ChildReply(0, ("arm.not_connected", str(error))))
        os._exit(2)
    child.serve()


if __name__ == "__main__":
    if sys.argv[1] == "--safe":
        make_safe(sys.argv[2], [int(index) for index in sys.argv[3].split(",") if index])
    _serve(int(sys.argv[1]))
