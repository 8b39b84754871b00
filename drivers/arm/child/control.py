"""Child side: the thread that commands the arm. One request at a time; a stop overtakes everything.

Moves and stops are started asynchronously and watched: a synchronous one cannot be interrupted, and nothing could be
sent meanwhile to keep the controller's watchdog quiet. A motion that ends otherwise than at its end or by a stop ends
the whole program: one that is only paused would go on when it is released.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from drivers.arm.child.program import KICK_S, PERIOD, SETTLE_S, ControlProgram, End, joints_off
from drivers.arm.child.streaming import Streaming
from drivers.arm.feed import UNANSWERED, ChildReply, ChildRequest, ChildSetup, Ended, Snapshot, StreamTiming
from drivers.arm.motion import JointTrajectory, pose_difference
from drivers.clock import Clock

if TYPE_CHECKING:
    from rtde_control import RTDEControlInterface

_PLACE_TOLERANCE, _TURN_TOLERANCE = 1e-3, 2e-3


class ControlThread:
    """Carries out requests on an `RTDEControlInterface`, or refuses them with the arm's problem when there is none."""

    def __init__(
        self, setup: ChildSetup, control: RTDEControlInterface, latest: Callable[[], Snapshot],
        send: Callable[[ChildReply | Ended], None], lose: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._control = control
        self._send = send
        self._lose = lose
        self._clock = Clock()
        self._program = ControlProgram(setup, control, latest)
        self._streaming = Streaming(setup, control, self._program, latest)
        self._requests: queue.SimpleQueue[ChildRequest] = queue.SimpleQueue()
        self._cause: End | None = None
        self.finished = threading.Event()
        threading.Thread(target=self._run, name="arm control", daemon=True).start()

    def stop_because(self, code: str, text: str) -> None:
        """Stop what moves; its motion then ends with this fault."""
        self._cause = code, text
        self.submit(ChildRequest(UNANSWERED, "stop"))

    @property
    def late(self) -> float:
        """See `ControlProgram.late`."""
        return self._program.late

    def submit(self, request: ChildRequest) -> None:
        """Queue a request. A stop drops what waits and ends what runs."""
        if request.name in ("stop", "close"):
            self._program.to_stop.set()
            kept: list[ChildRequest] = []
            with suppress(queue.Empty):
                while True:
                    dropped = self._requests.get_nowait()
                    if dropped.name in ("stop", "close"):
                        kept.append(dropped)
                    else:
                        self._send(ChildReply(dropped.number, ("arm.stopped", "")))
            for stop in kept:
                self._requests.put(stop)
        self._requests.put(request)

    def _run(self) -> None:
        while not self.finished.is_set():
            request: ChildRequest | None
            try:
                request = self._requests.get(timeout=KICK_S)
            except queue.Empty:
                request = None
            try:
                if request is None:
                    # Nothing moves: nothing comes late.
                    self._program.awake(math.inf)
                    self._program.kick()
                else:
                    self._serve(request)
            # Whatever ur-rtde throws here, its link cannot be trusted any more.
            except RuntimeError as error:
                self._lose(f"ur-rtde failed: {error}")

    def _serve(self, request: ChildRequest) -> None:
        match request.name:
            case "stop":
                self._program.to_stop.clear()
                self._send(ChildReply(request.number, self._program.brake()))
                self._cause = None
            case "close":
                # Whoever never had the arm leaves it as it is.
                if self._control is not None:
                    self._program.brake()
                    if self._control.isProgramRunning():
                        self._control.stopScript()
                self.finished.set()
            case "zero_force":
                self._answer(request, lambda: bool(self._control.zeroFtSensor()))
            case "payload":
                mass, centre = request.arguments
                self._answer(request, lambda: bool(self._control.setPayload(mass, list(centre))))
            case "move_joints":
                self._move_joints(request)
            case "move_linear":
                self._move_linear(request)
            case "follow":
                self._follow(request)
            case other:
                self._send(ChildReply(request.number, ("arm.internal", f"unknown request '{other}'")))

    def _answer(self, request: ChildRequest, act: Callable[[], bool]) -> None:
        problem = self._program.problem()
        if problem is None and not act():
            problem = self._program.problem() or ("arm.refused", f"the controller did not accept '{request.name}'")
        self._send(ChildReply(request.number, problem))

    def _move_joints(self, request: ChildRequest) -> None:
        motion, target, speed, acceleration = request.arguments

        def missed(snapshot: Snapshot) -> str:
            return joints_off(snapshot, target, "its target")

        self._move(request, motion, lambda: self._control.moveJ(list(target), speed, acceleration, True), missed)

    def _move_linear(self, request: ChildRequest) -> None:
        motion, target, speed, acceleration = request.arguments

        def missed(snapshot: Snapshot) -> str:
            way, turn = pose_difference(snapshot.flange, target)
            near = way < _PLACE_TOLERANCE and turn < _TURN_TOLERANCE
            return "" if near else f"the flange is {1e3 * way:.3g} mm and {math.degrees(turn):.3g} deg off its target"

        self._move(request, motion, lambda: self._control.moveL(list(target), speed, acceleration, True), missed)

    def _move(
        self, request: ChildRequest, motion: int, start: Callable[[], bool], missed: Callable[[Snapshot], str]
    ) -> None:
        problem = self._program.problem()
        before = self._program.operation()[0]
        if problem is None and not start():
            problem = self._program.problem() or ("arm.refused", "the controller did not accept the move")
        self._send(ChildReply(request.number, problem))
        if problem is None:
            self._end(motion, *(self._watch(before) or self._program.settled(missed)))

    def _end(self, motion: int, how: str, text: str, pace: StreamTiming | None = None) -> None:
        if how == "stopped" and self._cause is not None:
            how, text = self._cause
        if how not in ("arrived", "contact", "stopped") and (problem := self._program.end()) is not None:
            text = "; ".join(filter(None, (text, problem[1])))
        self._send(Ended(motion, how, text, pace))

    def _watch(self, before: int) -> End | None:
        """Until the controller reports the end of the operation after `before`: None, or why it ended early."""
        begun = time.monotonic()
        self._program.awake(math.inf)
        while True:
            if self._program.to_stop.is_set():
                return self._program.brake() or ("stopped", "")
            if (problem := self._program.problem()) is not None:
                return problem
            operation, running = self._program.operation()
            if operation != before and not running:
                return None
            if operation == before and time.monotonic() - begun > SETTLE_S:
                return "arm.refused", "the controller accepted the move but did not begin it"
            self._program.kick()
            self._clock.sleep(PERIOD)

    def _follow(self, request: ChildRequest) -> None:
        motion, times, joints, force_limit = request.arguments
        problem = self._program.problem()
        self._send(ChildReply(request.number, problem))
        if problem is None:
            how, text = self._streaming.stream(JointTrajectory(times, joints), force_limit)
            self._end(motion, how, text, self._streaming.pace)
