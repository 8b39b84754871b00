"""Child side: the process in which ur-rtde lives, since it can crash or hang (docs/protocols.md, section 7).

It ends by itself, with the motion stopped and the safe outputs off, as soon as its owner is gone (the pipe ends, or
another parent has taken over), and at once when the arm is gone. Run by the driver; with `--safe ADDRESS 0,3` it only
switches outputs off and sees that the arm stands.
"""

from __future__ import annotations

import os
import resource
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any

from rtde_control import RTDEControlInterface
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface

from drivers.arm.dashboard import Dashboard
from drivers.arm.messages import AT_REST, MODE_RUNNING, Ended, Lost, Reply, Request, Setup, Snapshot, safety_code
from drivers.arm.outbox import Message, Outbox
from drivers.arm.ur_control import PERIOD, ControlThread
from drivers.clock import Clock
from drivers.errors import DeviceError

SILENCE_S = 1.5
"""The arm counts as lost after this time without a packet; it sends one every 2 ms."""
_CONSTRUCTION_S = 15.0
_SHUT_DOWN_S = 5.0
_PUSHES_PER_S = 125.0
_VARIABLES = [
    "timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "actual_TCP_force", "actual_digital_input_bits",
    "actual_digital_output_bits", "robot_mode", "robot_status_bits", "safety_status_bits", "runtime_state",
]  # fmt: skip
_SECONDARY_PORT = 30002
_GREETING = 79
"""Bytes that the maker wants read from that port before it is closed; else what was sent may be discarded."""
_LOW_WHEN_NOT_RUNNING = 1
_OFF_S = 1.0
_STOPPED = 1
"""`runtime_state` of an arm on which no program runs; larger ones play, pause or resume."""
_LAST_WORDS_S = 0.5
_NOT_SAFE = 4
"""Exit code of `--safe` when an output stays on or the arm does not come to rest."""


class Child:
    """Connects to the arm and serves the owner at the other end of `pipe`."""

    def __init__(self, pipe: Connection, setup: Setup) -> None:
        self._pipe = pipe
        self._setup = setup
        self._parent = os.getppid()
        self._clock = Clock()
        with _ends_by_itself(_CONSTRUCTION_S):
            self._receive = RTDEReceiveInterface(setup.address, 500.0, _VARIABLES)
            self._snapshot = self._read()
            control = self._take_control() if setup.control else None
        # Nobody listens: the same as the end of the pipe, which the main thread may not have seen yet.
        self._outbox = Outbox(pipe, lambda: os.kill(os.getpid(), signal.SIGTERM))
        self._control = ControlThread(setup, control, lambda: self._snapshot, self._send, self._lose)
        threading.Thread(target=self._watch_arm, name="arm state", daemon=True).start()

    def _take_control(self) -> Any:
        """The control interface, or None while the arm is not ready for one: its state is still served.

        An arm that another client holds refuses here, before anything on it has been changed.
        """
        address = self._setup.address
        self._io = RTDEIOInterface(address)
        ready = not safety_code(self._snapshot.safety_bits) and self._snapshot.mode == MODE_RUNNING
        control = RTDEControlInterface(address) if ready else None
        try:
            self._outputs_off()
            _let_go_low(address, self._setup.safe_off)
            if control is not None:
                self._see_running()
                _prepare(control, self._setup)
        except (RuntimeError, OSError):
            if control is not None:
                control.stopScript()
            raise
        self._snapshot = self._read()
        return control

    def _see_running(self) -> None:
        """The state comes over a connection of its own, and may be older than the program's start."""
        deadline = time.monotonic() + _OFF_S
        while not self._read().program_running and time.monotonic() < deadline:
            self._clock.sleep(PERIOD)

    def _outputs_off(self) -> None:
        """Whatever a lost link has left behind."""
        mask = sum(1 << index for index in self._setup.safe_off)
        for index in self._setup.safe_off:
            switch_output(self._io, index, False)
        deadline = time.monotonic() + _OFF_S
        while self._read().outputs & mask:
            if time.monotonic() > deadline:
                raise RuntimeError(f"outputs {self._setup.safe_off} cannot be switched off")
            self._clock.sleep(PERIOD)

    def serve(self) -> None:
        """Obey the owner until it asks for the end or is gone, then end the process."""
        self._send(self._snapshot)
        self._send(Reply(0))
        closing = 0
        with suppress(EOFError, OSError):
            while True:
                request: Request = self._pipe.recv()
                if request.name == "close":
                    closing = request.number
                    break
                if request.name == "output":
                    self._send(Reply(request.number, self._switch(*request.arguments)))
                else:
                    self._control.submit(request)
        self.shut_down(closing)

    def _switch(self, index: int, value: bool) -> tuple[str, str] | None:
        if switch_output(self._io, index, value):
            return None
        return "arm.refused", f"the controller did not accept a value for output {index}"

    def shut_down(self, closing: int = 0) -> None:
        """Outputs off, motion stopped, then the end; bounded in time whatever the arm does."""
        signal.setitimer(signal.ITIMER_REAL, _SHUT_DOWN_S)
        if self._setup.control:
            self._leave_safe()
        if closing:
            self._send(Reply(closing))
            self._outbox.drain(_LAST_WORDS_S)
        # The destructors of ur-rtde may hang or abort: the kernel closes the sockets.
        os._exit(0)

    def _leave_safe(self) -> None:
        for index in self._setup.safe_off:
            switch_output(self._io, index, False)
        self._control.submit(Request(0, "close"))
        if not self._control.finished.wait(3.0):
            with suppress(DeviceError):
                Dashboard("arm", self._setup.address).ask("stop")
        mask = sum(1 << index for index in self._setup.safe_off)
        for _ in range(250):
            if not self._snapshot.outputs & mask:
                break
            self._clock.sleep(PERIOD)

    # --- state ---

    def _watch_arm(self) -> None:
        every = max(1, round(1.0 / (PERIOD * _PUSHES_PER_S * self._setup.rate)))
        count = 0
        while True:
            self._clock.sleep(0.5 * PERIOD)
            before = self._snapshot
            if not self._receive.isConnected():
                self._lose("the arm closed the connection")
            if os.getppid() != self._parent:
                os.kill(os.getpid(), signal.SIGTERM)
                self._parent = os.getppid()
            stamp = self._receive.getTimestamp()
            if stamp == self._controller_time:
                if time.monotonic() - before.stamp > SILENCE_S:
                    self._lose(f"no packet from the arm for {SILENCE_S:g} s")
                continue
            snapshot = self._snapshot = self._read()
            count += 1
            if count % every == 0 or _urgent(snapshot) != _urgent(before):
                self._send(snapshot)

    def _read(self) -> Snapshot:
        """The newest packet, read whole: again if another one has come in between."""
        receive = self._receive
        while True:
            self._controller_time: float = receive.getTimestamp()
            snapshot = Snapshot(
                stamp=time.monotonic(),
                joints=tuple(receive.getActualQ()),
                speeds=tuple(receive.getActualQd()),
                flange=tuple(receive.getActualTCPPose()),
                wrench=tuple(receive.getActualTCPForce()),
                safety_bits=receive.getSafetyStatusBits(),
                mode=receive.getRobotMode(),
                runtime=receive.getRuntimeState(),
                inputs=receive.getActualDigitalInputBits(),
                outputs=receive.getActualDigitalOutputBits(),
                device_time=self._controller_time,
            )
            if receive.getTimestamp() == self._controller_time:
                return snapshot

    def _lose(self, text: str) -> None:
        self._send(Lost(text))
        self._outbox.drain(_LAST_WORDS_S)
        os._exit(3)

    def _send(self, message: Message) -> None:
        if isinstance(message, Ended):
            # The owner must not see a state from before the end of a motion that it knows to have ended.
            self._outbox.put(self._snapshot)
        self._outbox.put(message)


def terminal(index: int) -> tuple[str, int]:
    """Kind and number of digital output `index`: 0-7 standard, 8-15 configurable, 16-17 tool."""
    kind = ("standard", "configurable", "tool")[index // 8]
    return kind, index % 8


def switch_output(io: Any, index: int, value: bool) -> bool:
    """Set digital output `index`."""
    kind, number = terminal(index)
    return bool(getattr(io, f"set{kind.capitalize()}DigitalOut")(number, value))


def _prepare(control: Any, setup: Setup) -> None:
    mass, centre = setup.payload
    steps: list[tuple[str, Callable[[], bool]]] = [
        ("the zero tool centre point", lambda: control.setTcp([0.0] * 6)),
        ("the payload", lambda: control.setPayload(mass, list(centre))),
        ("the watchdog", lambda: control.setWatchdog(1.0 / setup.watchdog)),
    ]
    for what, act in steps:
        if not act():
            raise RuntimeError(f"the controller did not accept {what}")


def _let_go_low(address: str, outputs: tuple[int, ...]) -> None:
    """Have the controller keep outputs low whenever no program runs, whatever becomes of the link.

    A secondary program runs beside the main one and leaves it alone. Source: the maker's script manual.
    """
    if not outputs:
        return
    lines = [
        f"  set_runstate_{kind}_digital_output_to_value({number}, {_LOW_WHEN_NOT_RUNNING})\n"
        for kind, number in map(terminal, outputs)
    ]
    with socket.create_connection((address, _SECONDARY_PORT), timeout=_OFF_S) as connection:
        connection.sendall(f"sec cell_outputs():\n{''.join(lines)}end\n".encode())
        read = 0
        while read < _GREETING:
            data = connection.recv(4096)
            if not data:
                raise RuntimeError(f"port {_SECONDARY_PORT} of the arm was closed before it took the outputs' setting")
            read += len(data)


def _urgent(snapshot: Snapshot) -> tuple[int, int, int, int, int]:
    return snapshot.safety_bits, snapshot.mode, snapshot.runtime, snapshot.inputs, snapshot.outputs


@contextmanager
def _ends_by_itself(seconds: float) -> Iterator[None]:
    """Inside this context the process is killed after `seconds`: a constructor that hangs lets no thread run."""
    signal.setitimer(signal.ITIMER_REAL, seconds)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0.0)


def _serve(descriptor: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.setswitchinterval(0.0005)
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
        setup: Setup = pipe.recv()
        child = Child(pipe, setup)
    except (RuntimeError, ValueError, EOFError, OSError) as error:
        with suppress(OSError):
            pipe.send(Reply(0, ("arm.not_connected", str(error))))
        os._exit(2)
    child.serve()


def _make_safe(address: str, outputs: list[int]) -> None:
    """Switch outputs off, then see on the arm's own word that they are and that it stands."""
    signal.setitimer(signal.ITIMER_REAL, _SHUT_DOWN_S)
    if outputs:
        io = RTDEIOInterface(address)
        for index in outputs:
            switch_output(io, index, False)
    receive = RTDEReceiveInterface(address, 500.0, _VARIABLES)
    mask = sum(1 << index for index in outputs)
    clock, deadline = Clock(), time.monotonic() + _OFF_S

    def unsafe() -> bool:
        moving = max(map(abs, receive.getActualQd())) >= AT_REST
        # A program that is only paused would go on when it is released.
        return bool(receive.getActualDigitalOutputBits() & mask) or moving or receive.getRuntimeState() > _STOPPED

    while unsafe():
        if time.monotonic() > deadline:
            os._exit(_NOT_SAFE)
        clock.sleep(PERIOD)
    os._exit(0)


if __name__ == "__main__":
    if sys.argv[1] == "--safe":
        _make_safe(sys.argv[2], [int(index) for index in sys.argv[3].split(",") if index])
    _serve(int(sys.argv[1]))
