"""Child side: the program that controls the arm: whether it can move, that it stays alive, how it is stopped."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from drivers.arm.dashboard import Dashboard
from drivers.arm.faults import LATE_S, late_words
from drivers.arm.feed import MODE_RUNNING, PLAYING, STOPPED, ChildSetup, Six, Snapshot, safety_code
from drivers.arm.motion import largest_difference
from drivers.clock import Clock
from drivers.errors import DeviceError

if TYPE_CHECKING:
    from rtde_control import RTDEControlInterface

PERIOD = 0.002
"""The arm's cycle, in s on the wall."""
SETTLE_S = 3.0
"""How long on the wall a move may take to begin, and the arm to stand at its end."""
BRAKING_S, _ENDING_S = 1.0, 0.7
"""How long on the wall the arm may take to come to rest, by its program and then by the end of its program."""
BLIND_S = 0.1
"""For how long on the wall the arm's own word may be behind what happens to it."""
KICK_S, _KICK_BLIND = 0.02, 0.7
"""How often the watchdog is kicked, in s on the wall, and for which part of its time without a word from the arm."""
LATE_KEPT_S = 0.5
_REST_S = 0.02
_JOINT_TOLERANCE = 2e-3

End = tuple[str, str]
"""How a motion ended, and the text to it."""


class ControlProgram:
    """The program that ur-rtde runs on the arm; without one (`interface` None) nothing moves, but a stop still works.
    `to_stop` is set as long as whatever moves is to come to rest."""

    def __init__(self, setup: ChildSetup, interface: RTDEControlInterface, latest: Callable[[], Snapshot]) -> None:
        self.to_stop = threading.Event()
        self._setup = setup
        self._control = interface
        self._latest = latest
        self._clock = Clock()
        self._dashboard = Dashboard("arm", setup.address, timeout=_ENDING_S)
        self._kicked = 0.0
        self._awake = math.inf
        self._late: deque[tuple[float, float]] = deque(maxlen=100)

    def awake(self, period: float) -> None:
        """Said at each turn of a loop that commands the arm: notes by how much it comes later than `period` s."""
        now = time.monotonic()
        self.note_late(now - self._awake - period)
        self._awake = now

    def note_late(self, seconds: float) -> None:
        """What the arm is told came this much late."""
        if seconds >= LATE_S:
            self._late.append((time.monotonic(), seconds))

    @property
    def late(self) -> float:
        """By how much at most what the arm was told came late in the last `LATE_KEPT_S`, s."""
        since = time.monotonic() - LATE_KEPT_S
        return max((seconds for at, seconds in tuple(self._late) if at >= since), default=0.0)

    def operation(self) -> tuple[int, bool]:
        """Number of the newest asynchronous operation, and whether it runs."""
        if self._control is None:
            return 0, False
        status = self._control.getAsyncOperationProgressEx()
        return status.operationId(), status.isAsyncOperationRunning()

    def problem(self) -> tuple[str, str] | None:
        """What keeps the arm from moving, if anything."""
        snapshot = self._latest()
        if code := safety_code(snapshot.safety_bits):
            return code, self._why(code)
        if snapshot.mode != MODE_RUNNING:
            return "arm.not_powered", f"robot mode {snapshot.mode}"
        if self._control is None:
            return "arm.program_stopped", ""
        return None if self._control.isProgramRunning() else self._why_ended()

    def _why_ended(self) -> tuple[str, str]:
        """Why the program does not run: its end may be seen a few packets before its cause."""
        deadline = time.monotonic() + BLIND_S
        while time.monotonic() < deadline:
            snapshot = self._latest()
            if code := safety_code(snapshot.safety_bits):
                return code, self._why(code)
            if snapshot.mode != MODE_RUNNING:
                return "arm.not_powered", f"robot mode {snapshot.mode}"
            self._clock.sleep(PERIOD)
        paused = self._latest().runtime not in (STOPPED, PLAYING)
        return "arm.program_stopped", "it was paused at the arm" if paused else late_words(self.late)

    def _why(self, code: str) -> str:
        return late_words(self.late) if code == "arm.protective_stop" else ""

    def brake(self) -> End | None:
        """Bring the arm to rest, and see to it that nothing of its motion can go on; None once that is so.

        A program that runs stops its motion and lives on. One that is paused, pausing or resuming cannot be reached: it
        is ended, and so is one that does not brake.
        """
        runs = self._control is not None and self._control.isProgramRunning()
        if runs:
            # It does not tell whether it was taken: the program's state does.
            self._control.stopJ(self._setup.braking, True)
        begun = time.monotonic()
        while runs and time.monotonic() - begun < BRAKING_S:
            snapshot = self._latest()
            if not snapshot.program_running:
                break
            if snapshot.at_rest and snapshot.stamp > begun:
                return None
            self.kick()
            self._clock.sleep(PERIOD)
        return self.end()

    def end(self) -> End | None:
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

    def kick(self) -> None:
        """Keep the watchdog quiet for as long as the arm is heard and its program runs."""
        self.awake(KICK_S)
        now, snapshot = time.monotonic(), self._latest()
        if (
            self._control is not None
            and now - self._kicked >= KICK_S
            and now - snapshot.stamp < _KICK_BLIND * self._setup.watchdog
            and snapshot.program_running
        ):
            self._kicked = now
            self._control.kickWatchdog()

    def settled(self, missed: Callable[[Snapshot], str]) -> End:
        """Wait until the arm has stood at the target for a moment."""
        standing = time.monotonic()
        deadline = standing + SETTLE_S
        while True:
            snapshot = self._latest()
            text = missed(snapshot) or ("" if snapshot.at_rest else "the arm does not come to rest")
            if text:
                standing = time.monotonic()
            elif snapshot.stamp - standing > _REST_S:
                return "arrived", ""
            if time.monotonic() > deadline:
                return self.problem() or ("arm.not_arrived", text)
            if self.to_stop.is_set():
                return self.brake() or ("stopped", "")
            self.kick()
            self._clock.sleep(PERIOD)


def joints_off(snapshot: Snapshot, target: Six, what: str) -> str:
    """How far the joints are off `target`, in words that call it `what`; empty when they are there."""
    error = largest_difference(snapshot.joints, target)
    return "" if error < _JOINT_TOLERANCE else f"a joint is {math.degrees(error):.3g} deg off {what}"
