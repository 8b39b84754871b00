"""Two ways to have work done and to look around meanwhile: in threads on the wall's clock, in line on a virtual one.

On the wall's clock the work has a thread of its own, so whoever watches can always act. On a virtual clock time moves
when somebody waits: the work is done in the thread that watches, so the same work takes the same course.
"""

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Protocol, runtime_checkable

from statemachine.control import Cancelled
from statemachine.watch import Call, RunClock, begin

POLL_S = 0.02
"""How often a watch looks around while work goes on: seconds on the wall, or of the virtual clock."""

Cut = Callable[[], str | None]
"""Asked at every look around: None while the work may go on, else why it ends; what moves has been stopped then."""


@runtime_checkable
class WaitableClock(RunClock, Protocol):
    """A clock whose time moves when somebody waits on it."""

    def checking(self, check: Callable[[], None]) -> AbstractContextManager[None]:
        """Inside this context `check()` is called each time this thread has let time pass; what it raises comes out of
        the wait. Takes the place of an outer one."""


class Waiting(Protocol):
    """How work is done under watch."""

    def do(self, name: str, work: Callable[[], object], cut: Cut, grace: float) -> Call:
        """Do `work()` and ask `cut()` meanwhile; once that gives a reason the work has `grace` seconds to end. What
        comes back is done unless it was still busy after that."""

    def check(self) -> None:
        """Called by work that is held on the wall's time, to see what is asked for; raises when it is to end."""

    def each(self, actions: Mapping[str, Callable[[], None]], timeout: float) -> list[str]:
        """Do every action whatever becomes of the others; a line for each that was not confirmed in `timeout` s."""


def waiting_on(clock: RunClock) -> Waiting:
    """The way that suits a clock."""
    return InLine(clock) if isinstance(clock, WaitableClock) else Threads(clock)


class Threads:
    """Each piece of work in a thread of its own; `clock` runs at its own pace."""

    def __init__(self, clock: RunClock) -> None:
        self._clock = clock

    def do(self, name: str, work: Callable[[], object], cut: Cut, grace: float) -> Call:
        """See `Waiting.do`."""
        call = begin(name, work)
        while not self._clock.wait(call.done, POLL_S * self._clock.rate):
            if cut() is not None:
                self._clock.wait(call.done, grace * self._clock.rate)
                break
        return call

    def check(self) -> None:
        """Somebody else looks around."""

    def each(self, actions: Mapping[str, Callable[[], None]], timeout: float) -> list[str]:
        """All at once, none waits for another; `timeout` is on the wall. See `Waiting.each`."""
        calls = {what: begin(f"safe stop: {what}", action) for what, action in actions.items()}
        deadline = time.monotonic() + timeout
        problems = []
        for what, call in calls.items():
            if not call.done.wait(max(0.0, deadline - time.monotonic())):
                problems.append(f"{what}: not confirmed within {timeout:.0f} s")
            # Whatever ended it: what it was to confirm is not confirmed.
            elif call.error is not None:
                problems.append(f"{what}: not confirmed, {call.error}")
        return problems


class InLine:
    """Everything in the thread that asks for it, one after another; `clock` moves when it waits."""

    def __init__(self, clock: WaitableClock) -> None:
        self._clock = clock
        self._look_out: _LookOut | None = None

    def do(self, name: str, work: Callable[[], object], cut: Cut, grace: float) -> Call:
        """See `Waiting.do`. Work that ends early does so by `Cancelled`, out of its wait."""
        call = Call()
        outer, self._look_out = self._look_out, _LookOut(self._clock, cut, grace)
        try:
            with self._clock.checking(self._look_out.moved):
                call.perform(work)
        finally:
            self._look_out = outer
        return call

    def check(self) -> None:
        """Look around now, although no time has passed."""
        if self._look_out is not None:
            self._look_out.check()

    def each(self, actions: Mapping[str, Callable[[], None]], timeout: float) -> list[str]:
        """One after another; `timeout` is of the virtual clock. See `Waiting.each`."""
        problems = []
        for what, action in actions.items():
            late = _within(self._clock, timeout)
            call = self.do(what, action, late, timeout)
            # Also an action that caught its end and went on confirms nothing.
            if (why := call.error or late()) is not None:
                problems.append(f"{what}: not confirmed, {why}")
        return problems


def _within(clock: RunClock, timeout: float) -> Cut:
    until = clock.now() + timeout
    return lambda: f"it took longer than {timeout:.0f} s" if clock.now() > until else None


class _LookOut:
    """Looks around for work in line; `moved` is called each time that has let time pass."""

    def __init__(self, clock: WaitableClock, cut: Cut, grace: float) -> None:
        self._clock = clock
        self._cut = cut
        self._grace = grace
        self._due = clock.now() + POLL_S
        self._reason: str | None = None
        self._busy = False

    def moved(self) -> None:
        """Look around if it is time to."""
        if self._clock.now() >= self._due:
            self.check()

    def check(self) -> None:
        """Ask whether the work is to end, and raise `Cancelled` if so; again and again for work that goes on then."""
        # The stop that ends the work waits as well, and is not to be ended by what it is for.
        if self._busy:
            return
        if self._reason is None:
            self._busy = True
            try:
                self._reason = self._cut()
            finally:
                self._busy = False
        self._due = self._clock.now() + (POLL_S if self._reason is None else self._grace)
        if self._reason is not None:
            raise Cancelled(self._reason)
