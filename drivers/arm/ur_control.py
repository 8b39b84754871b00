"""Child side: the thread that commands the arm. One request at a time; a stop overtakes everything.

Moves and stops are started asynchronously and watched: a synchronous one cannot be interrupted, and nothing could be
sent meanwhile to keep the controller's watchdog quiet. A joint trajectory is streamed on absolute deadlines of 2 ms,
never far ahead of what the arm has reported. A motion that ends otherwise than at its end or by a stop ends the whole
program: one that is only paused would go on when it is released.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from drivers.arm.dashboard import Dashboard
from drivers.arm.messages import (
    MODE_RUNNING,
    PLAYING,
    STOPPED,
    Ended,
    Reply,
    Request,
    Setup,
    Six,
    Snapshot,
    safety_code,
)
from drivers.arm.trajectory import Trajectory, largest_difference, pose_difference
from drivers.clock import Clock
from drivers.errors import DeviceError

PERIOD = 0.002
_LOOKAHEAD, _GAIN = 0.05, 500
_SERVO_BRAKING = 10.0
_KICK_S, _KICK_BLIND = 0.02, 0.7
"""How often the watchdog is kicked, in s on the wall, and for which part of its time without a word from the arm."""
_SLIP_S = 0.004
_BLIND_S, _FEELING_S = 0.1, 0.02
"""How far streaming may run ahead of what the arm has reported, in seconds on the wall: at most, and in contact."""
_SETTLE_S = 3.0
_BRAKING_S, _ENDING_S = 1.0, 0.7
"""How long on the wall the arm may take to come to rest, by its program and then by the end of its program."""
_REST_S = 0.02
_JOINT_TOLERANCE, _PLACE_TOLERANCE, _TURN_TOLERANCE = 2e-3, 1e-3, 2e-3

End = tuple[str, str]
"""How a motion ended, and the text to it."""


class ControlThread:
    """Carries out requests on an `RTDEControlInterface`, or refuses them with the arm's problem when there is none."""

    def __init__(
        self,
        setup: Setup,
        control: Any,
        latest: Callable[[], Snapshot],
        send: Callable[[Reply | Ended], None],
        lose: Callable[[str], None],
    ) -> None:
        self._setup = setup
        self._control = control
        self._latest = latest
        self._send = send
        self._lose = lose
        self._clock = Clock()
        self._dashboard = Dashboard("arm", setup.address, timeout=_ENDING_S)
        self._requests: queue.SimpleQueue[Request] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._kicked = 0.0
        self.finished = threading.Event()
        threading.Thread(target=self._run, name="arm control", daemon=True).start()

    def submit(self, request: Request) -> None:
        """Queue a request. A stop drops what waits and ends what runs."""
        if request.name in ("stop", "close"):
            self._stop.set()
            stops: list[Request] = []
            with suppress(queue.Empty):
                while True:
                    dropped = self._requests.get_nowait()
                    if dropped.name == "stop":
                        stops.append(dropped)
                    else:
                        self._send(Reply(dropped.number, ("arm.stopped", "")))
            for stop in stops:
                self._requests.put(stop)
        self._requests.put(request)

    def _run(self) -> None:
        while not self.finished.is_set():
            request: Request | None
            try:
                request = self._requests.get(timeout=_KICK_S)
            except queue.Empty:
                request = None
            try:
                if request is None:
                    self._kick()
                else:
                    self._serve(request)
            # Whatever ur-rtde throws here, its link cannot be trusted any more.
            except RuntimeError as error:
                self._lose(f"ur-rtde failed: {error}")

    def _serve(self, request: Request) -> None:
        match request.name:
            case "stop":
                self._stop.clear()
                self._send(Reply(request.number, self._brake()))
            case "close":
                # Whoever never had the arm leaves it as it is.
                if self._control is not None:
                    self._brake()
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
                self._send(Reply(request.number, ("arm.internal", f"unknown request '{other}'")))

    def _answer(self, request: Request, act: Callable[[], bool]) -> None:
        problem = self._problem()
        if problem is None and not act():
            problem = self._problem() or ("arm.refused", f"the controller did not accept '{request.name}'")
        self._send(Reply(request.number, problem))

    # --- moves of the controller's own ---

    def _move_joints(self, request: Request) -> None:
        motion, target, speed, acceleration = request.arguments

        def missed(snapshot: Snapshot) -> str:
            error = largest_difference(snapshot.joints, target)
            return "" if error < _JOINT_TOLERANCE else f"a joint is {math.degrees(error):.3g} deg off its target"

        self._move(request, motion, lambda: self._control.moveJ(list(target), speed, acceleration, True), missed)

    def _move_linear(self, request: Request) -> None:
        motion, target, speed, acceleration = request.arguments

        def missed(snapshot: Snapshot) -> str:
            way, turn = pose_difference(snapshot.flange, target)
            near = way < _PLACE_TOLERANCE and turn < _TURN_TOLERANCE
            return "" if near else f"the flange is {1e3 * way:.3g} mm and {math.degrees(turn):.3g} deg off its target"

        self._move(request, motion, lambda: self._control.moveL(list(target), speed, acceleration, True), missed)

    def _move(
        self, request: Request, motion: int, start: Callable[[], bool], missed: Callable[[Snapshot], str]
    ) -> None:
        problem = self._problem()
        before = self._operation()[0]
        if problem is None and not start():
            problem = self._problem() or ("arm.refused", "the controller did not accept the move")
        self._send(Reply(request.number, problem))
        if problem is None:
            self._end(motion, *(self._watch(before) or self._settled(missed)))

    def _end(self, motion: int, how: str, text: str) -> None:
        if how not in ("arrived", "contact", "stopped") and (problem := self._end_program()) is not None:
            text = "; ".join(filter(None, (text, problem[1])))
        self._send(Ended(motion, how, text))

    def _operation(self) -> tuple[int, bool]:
        if self._control is None:
            return 0, False
        status = self._control.getAsyncOperationProgressEx()
        return status.operationId(), status.isAsyncOperationRunning()

    def _watch(self, before: int) -> End | None:
        """Until the controller reports the end of the operation after `before`: None, or why it ended early."""
        begun = time.monotonic()
        while True:
            if self._stop.is_set():
                return self._brake() or ("stopped", "")
            if (problem := self._problem()) is not None:
                return problem
            operation, running = self._operation()
            if operation != before and not running:
                return None
            if operation == before and time.monotonic() - begun > _SETTLE_S:
                return "arm.refused", "the controller accepted the move but did not begin it"
            self._kick()
            self._clock.sleep(PERIOD)

    def _settled(self, missed: Callable[[Snapshot], str]) -> End:
        """Wait until the arm has stood at the target for a moment."""
        standing = time.monotonic()
        deadline = standing + _SETTLE_S
        while True:
            snapshot = self._latest()
            text = missed(snapshot) or ("" if snapshot.at_rest else "the arm does not come to rest")
            if text:
                standing = time.monotonic()
            elif snapshot.stamp - standing > _REST_S:
                return "arrived", ""
            if time.monotonic() > deadline:
                return self._problem() or ("arm.not_arrived", text)
            if self._stop.is_set():
                return self._brake() or ("stopped", "")
            self._kick()
            self._clock.sleep(PERIOD)

    # --- streaming ---

    def _follow(self, request: Request) -> None:
        motion, times, joints, force_limit = request.arguments
        problem = self._problem()
        self._send(Reply(request.number, problem))
        if problem is None:
            self._end(motion, *self._stream(Trajectory(times, joints), force_limit))

    def _stream(self, trajectory: Trajectory, force_limit: float | None) -> End:
        """Stream the trajectory, time running `rate` times as fast as the wall, then stand still.

        A stop slows time down to nothing, so that the arm brakes on its way: the controller's own stop takes all its
        time in one command, in which its watchdog would bark.
        """
        force_before = self._mean_force() if force_limit is not None else ()
        allowed = _BLIND_S if force_limit is None else _FEELING_S
        start = time.monotonic()
        seen, lead = self._latest().device_time, 0.0
        cycle, how, text = 0, "", ""
        elapsed, pace, slower, braked_by = 0.0, 1.0, 0.0, math.inf
        while not how:
            due = start + cycle * PERIOD
            self._clock.sleep(due - time.monotonic())
            late = time.monotonic() - due
            if late > _SLIP_S:
                # The machine held this thread up. Going on where the arm is told to stand, not where it should have
                # been by now: the latter would be a jump.
                start += late
            newest = self._latest().device_time
            lead, seen = max(0.0, lead - (newest - seen) / self._setup.rate), newest
            if self._stop.is_set() and not slower:
                slower = PERIOD * self._setup.rate * _SERVO_BRAKING / max(trajectory.speed_at(elapsed), 1e-6)
                braked_by = time.monotonic() + _BRAKING_S
            if lead > allowed:
                # The arm would go on unseen, and what is sent would pile up before it and before the next stop.
                start += PERIOD
                self._kick()
            elif self._control.servoJ(list(trajectory.at(elapsed)), 0.0, 0.0, PERIOD, _LOOKAHEAD, _GAIN):
                cycle += 1
                lead += PERIOD
                elapsed += PERIOD * self._setup.rate * pace
                pace = max(0.0, pace - slower)
            else:
                how, text = self._problem() or ("arm.refused", "the controller did not accept a streamed point")
                break
            standing = pace == 0.0 and self._latest().at_rest
            if self._stop.is_set() and (standing or lead > allowed or time.monotonic() > braked_by):
                how = "stopped"
            else:
                how, text = self._stream_end(trajectory, elapsed, force_before, force_limit)
        self._control.servoStop(_SERVO_BRAKING)
        if how == "arrived":
            return self._settled(lambda snapshot: _off(snapshot, trajectory.end))
        return self._brake() or (how, text) if how in ("stopped", "contact") else (how, text)

    def _stream_end(self, trajectory: Trajectory, elapsed: float, before: Six, force_limit: float | None) -> End:
        """Whether streaming is over, and why; an empty reason to go on."""
        snapshot = self._latest()
        if (problem := self._problem()) is not None:
            return problem
        if force_limit is not None and math.dist(snapshot.wrench[:3], before) > force_limit:
            return "contact", ""
        late = elapsed - trajectory.duration
        if late >= 0 and (not _off(snapshot, trajectory.end) and snapshot.at_rest):
            return "arrived", ""
        if late > _SETTLE_S * self._setup.rate:
            return "arm.not_arrived", _off(snapshot, trajectory.end) or "the arm does not come to rest"
        return "", ""

    def _mean_force(self) -> Six:
        samples: list[Six] = []
        for _ in range(10):
            samples.append(self._latest().wrench[:3])
            self._clock.sleep(PERIOD)
        return tuple(sum(values) / len(samples) for values in zip(*samples, strict=True))

    # --- common ---

    def _problem(self) -> tuple[str, str] | None:
        """What keeps the arm from moving, if anything."""
        snapshot = self._latest()
        if code := safety_code(snapshot.safety_bits):
            return code, ""
        if snapshot.mode != MODE_RUNNING:
            return "arm.not_powered", f"robot mode {snapshot.mode}"
        if self._control is None:
            return "arm.program_stopped", ""
        return None if self._control.isProgramRunning() else self._why_ended()

    def _why_ended(self) -> tuple[str, str]:
        """Why the program does not run: its end may be seen a few packets before its cause."""
        deadline = time.monotonic() + _BLIND_S
        while time.monotonic() < deadline:
            snapshot = self._latest()
            if code := safety_code(snapshot.safety_bits):
                return code, ""
            if snapshot.mode != MODE_RUNNING:
                return "arm.not_powered", f"robot mode {snapshot.mode}"
            self._clock.sleep(PERIOD)
        paused = self._latest().runtime not in (STOPPED, PLAYING)
        return "arm.program_stopped", "it was paused at the arm" if paused else ""

    def _brake(self) -> End | None:
        """Bring the arm to rest, and see to it that nothing of its motion can go on; None once that is so.

        A program that runs stops its motion and lives on. One that is paused, pausing or resuming cannot be reached: it
        is ended, and so is one that does not brake.
        """
        runs = self._control is not None and self._control.isProgramRunning()
        if runs:
            # It does not tell whether it was taken: the program's state does.
            self._control.stopJ(self._setup.braking, True)
        begun = time.monotonic()
        while runs and time.monotonic() - begun < _BRAKING_S:
            snapshot = self._latest()
            if not snapshot.program_running:
                break
            if snapshot.at_rest and snapshot.stamp > begun:
                return None
            self._kick()
            self._clock.sleep(PERIOD)
        return self._end_program()

    def _end_program(self) -> End | None:
        """End whatever program the arm has, which stops the arm; None once there is none and the arm stands."""
        if self._ended():
            return None
        try:
            reply = self._dashboard.ask("stop")
        except DeviceError as error:
            return "arm.not_stopped", f"its program could not be ended: {error.message}"
        deadline = time.monotonic() + _ENDING_S
        while not self._ended():
            if time.monotonic() > deadline:
                return "arm.not_stopped", f"its program could not be ended, the dashboard server says '{reply}'"
            self._clock.sleep(PERIOD)
        return None

    def _ended(self) -> bool:
        snapshot = self._latest()
        return snapshot.runtime == STOPPED and snapshot.at_rest

    def _kick(self) -> None:
        """Keep the watchdog quiet for as long as the arm is heard and its program runs."""
        now, snapshot = time.monotonic(), self._latest()
        if (
            self._control is not None
            and now - self._kicked >= _KICK_S
            and now - snapshot.stamp < _KICK_BLIND * self._setup.watchdog
            and snapshot.program_running
        ):
            self._kicked = now
            self._control.kickWatchdog()


def _off(snapshot: Snapshot, target: Six) -> str:
    error = largest_difference(snapshot.joints, target)
    return "" if error < _JOINT_TOLERANCE else f"a joint is {math.degrees(error):.3g} deg off the trajectory's end"
