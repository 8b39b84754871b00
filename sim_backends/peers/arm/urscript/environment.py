"""What the commands of a URScript program share: the arm, who moves it, its messages and its connections."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from sim_backends.models.arm_motion import SimulatedMotion, StopMotion
from sim_backends.models.arm_streams import ForceMode
from sim_backends.peers.arm.script.context import CYCLE, Context, Job, ProgramError
from sim_backends.peers.arm.script.outputs import HeldOutputs

Announce = Callable[[str, str], None]
"""Tells the clients of the primary port: the kind of message (text, popup) and its words."""
_BRAKE = 4.0
"""Deceleration in rad/s² of a motion whose thread was killed or whose stream dried up."""


_MOST_READS = 10
"""Readings of sockets in one cycle."""


class Environment:
    """Of one program run; `context` has the arm and its registers, and `pause` pauses the program."""

    def __init__(self, outputs: HeldOutputs, announce: Announce, pause: Callable[[], object]) -> None:
        self.context: Context
        self.outputs = outputs
        self.announce = announce
        self.pause = pause
        self.thread = 0
        self.force: ForceMode | None = None
        self.popup_open = False
        self.cycles = 0
        self.held_up = False
        """This cycle is made up for: the host did not let the controller run in time, and perhaps no client either."""
        self._reads = 0
        self.watches: list[InputWatchdog] = []
        self._numbers = itertools.count(1)
        self._mover: int | None = None
        self._stream_ends: int | None = None
        self._closers: list[Callable[[], None]] = []

    def next_thread(self) -> int:
        """A number for a new thread; 0 is the program itself."""
        return next(self._numbers)

    def may_read(self) -> bool:
        """Whether what has come in over a socket is taken in this cycle; a flood is taken in parts."""
        self._reads += 1
        return self._reads <= _MOST_READS

    def on_close(self, act: Callable[[], None]) -> None:
        """Have `act` done when the program ends."""
        self._closers.append(act)

    def close(self) -> None:
        """The program has ended."""
        for act in self._closers:
            act()
        self._closers.clear()
        self.force = None

    # --- moving ---

    def move(self, motion: SimulatedMotion) -> Job:
        """Start `motion` and wait for its end. Raises `ProgramError` while another thread moves the arm."""
        model = self.context.model
        with self._moving():
            self._stream_ends = None
            model.start(motion)
            while model.pending(motion):
                yield

    def stream(self, motion: SimulatedMotion, seconds: float, lasting: bool = False) -> Job:
        """Have `motion` go on for `seconds`, one cycle at least; it dries up then, unless it is `lasting`."""
        model = self.context.model
        with self._moving():
            if model.motion is not motion:
                model.start(motion)
            cycles = max(1, round(seconds / CYCLE))
            self._stream_ends = None if lasting else self.cycles + cycles + 1
            for _ in range(cycles):
                yield

    def end_cycle(self) -> None:
        """After all threads: brake a stream that nobody has fed, be compliant while nothing moves, mind the watches."""
        self.cycles += 1
        self._reads = 0
        model = self.context.model
        if self._stream_ends is not None and self.cycles > self._stream_ends:
            self._stream_ends = None
            model.start(StopMotion(_BRAKE))
        if self.force is not None and model.idle:
            model.start(self.force)
        for watch in self.watches:
            watch.check(self.cycles)

    @contextmanager
    def _moving(self) -> Iterator[None]:
        thread = self.thread
        if self._mover not in (None, thread):
            raise ProgramError("another thread is already controlling the robot")
        self._mover = thread
        try:
            yield
        except GeneratorExit:
            self.context.model.start(StopMotion(_BRAKE))
            raise
        finally:
            self._mover = None


class InputWatchdog:
    """An input that a client has to write to at least every `seconds`, or `act` is done; `writes` counts."""

    def __init__(self, seconds: float, writes: Callable[[], int], act: Callable[[], object]) -> None:
        self._limit = seconds / CYCLE
        self._writes = writes
        self._act = act
        self._seen = writes()
        self._at: int | None = None

    def check(self, cycle: int) -> None:
        """Once in each cycle."""
        if self._at is None or self._writes() != self._seen:
            self._seen, self._at = self._writes(), cycle
        elif cycle - self._at > self._limit:
            self._at = cycle
            self._act()
