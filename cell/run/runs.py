"""A run as its starter holds it, and the runs of one cell: one goes on at a time.

Jobs, calibrations, verifications, homing and jogs are all runs. A stop counts for what was asked for before it.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from cell.base.storage import strict
from cell.run.events import Detached, Subscription
from drivers.errors import Aborted, DeadlineError, InterlockError
from statemachine.control import RunControl
from statemachine.step import Event, Observer
from statemachine.watch import SignalInterrupt, SignalWatch, begin

if TYPE_CHECKING:
    import pinocchio as pin

    from cell.procedures.frame_store import FrameStore
    from cell.procedures.sweep.swath import Sweeping


Result = TypeVar("Result", covariant=True)

POLL_S = 0.05
KEPT_EVENTS = 1000

log = logging.getLogger(__name__)


class Run(Generic[Result]):
    """A run that was begun. Every method may be called from any thread.

    `kind` is job, calibration, verification, homing or jog. `folder` is where the run is recorded, None until then.
    `frames` keeps what it looks at and `sweeping` its newest sweep, None before, `registered` where the surface
    was found in it (base_from_surface), None until then: whoever shows them takes the newest from there.
    """

    def __init__(self, kind: str, work: Callable[[Run[Result]], Result], observer: Observer | None = None) -> None:
        """Begin `work(run)` in a thread of its own. `observer` is told every event, in a thread of its own."""
        self.kind = kind
        self.folder: Path | None = None
        self.frames: FrameStore | None = None
        self.sweeping: Sweeping | None = None
        self.registered: pin.SE3 | None = None
        self.control = RunControl()
        self.record: Observer | None = None
        """Told every event before the run goes on, progress as well; while the run is recorded."""
        self._notifying = threading.Lock()
        self._over = False
        self._subscriptions: list[Subscription] = []
        self._past: deque[Event] = deque(maxlen=KEPT_EVENTS)
        self._observer = None if observer is None else Detached(observer)
        self._work = work
        self._call = begin(f"run: {kind}", self._perform)

    def pause(self) -> None:
        """Hold the run at its next safe point: before its next free motion or its next step."""
        self.control.pause()

    def go_on(self) -> None:
        """Let a paused run go on."""
        self.control.go_on()

    def end_batch(self) -> None:
        """Begin no other part of the batch after this run, which goes on to its own end."""
        self.control.end_batch = True

    def abort(self, reason: str = "aborted by the program that began it") -> None:
        """End the run: what moves is stopped at once. `result()` then says that it was aborted."""
        self.control.abort(reason)

    def confirm(self, by: str = "the program that began the run", number: int | None = None) -> bool:
        """Say that a person has looked and the run may go on; False when it waits for nobody's word. With the `number`
        of a `ConfirmNeeded` the word counts for that question only."""
        return self.control.confirm(by, number)

    def events(self) -> Subscription:
        """Iterate over the run's events (`events.py`) from its beginning to its end; who is slow misses progress."""
        subscription = Subscription()
        with self._notifying:
            for event in self._past:
                subscription.put(event)
            self._subscriptions.append(subscription)
            if self._over:
                subscription.close()
        return subscription

    @property
    def done(self) -> bool:
        """Whether the run has ended."""
        return self._call.done.is_set()

    def result(self, timeout: float | None = None) -> Result:
        """Wait for the end, at most `timeout` wall seconds (`DeadlineError`; the run goes on), and what it made.

        Ctrl-C, SIGTERM and SIGHUP end the run meanwhile, if this is the main thread. Raises what the run raised, and
        `SignalInterrupt` after a signal that came too late for the work to tell of it; a job's outcome does.
        """
        until = math.inf if timeout is None else time.monotonic() + timeout
        with SignalWatch() as signals:
            while not self._call.done.wait(max(0.0, min(POLL_S, until - time.monotonic()))):
                if signals.reason is not None:
                    self.control.abort(signals.reason, signals.number)
                if time.monotonic() > until:
                    raise DeadlineError(self.kind, f"has not ended within {timeout:g} s; it goes on")
        if signals.reason is not None and signals.number is not None:
            late = self.control.signal is None
            self.control.abort(signals.reason, signals.number)
            # It must not let the program go on to the next.
            if not self.control.over and (late or self._call.error is None):
                raise SignalInterrupt(signals.number) from self._call.error
        if self._call.error is not None:
            raise self._call.error
        result: Result = self._call.result  # type: ignore[assignment]
        return result

    def ended(self, timeout: float) -> None:
        """Wait for the end, whatever it is; `DeadlineError` when it does not come within `timeout` wall seconds."""
        if not self._call.done.wait(timeout):
            raise DeadlineError(self.kind, f"has not ended within {timeout:g} s")

    def notify(self, event: Event) -> None:
        """The run's work says what happens; nobody who listens can hold it up."""
        if event.kind != "progress":
            log.info("%s %s %s", event.step or self.kind, event.kind, json.dumps(strict(event.data)))
        if (record := self.record) is not None:
            record(event)
        with self._notifying:
            if event.kind != "progress":
                self._past.append(event)
            for subscription in self._subscriptions:
                subscription.put(event)
        if self._observer is not None:
            self._observer(event)

    def progress(self, fraction: float, text: str) -> None:
        """Tell how far the run's work is, 0 to 1."""
        self.notify(Event("progress", self.kind, {"fraction": fraction, "text": text}))

    def _perform(self) -> Result:
        try:
            return self._work(self)
        except BaseException as error:
            # Who asked for the end knows of it.
            log.log(logging.INFO if isinstance(error, Aborted) else logging.ERROR, "the %s ended: %s", self.kind, error)
            raise
        finally:
            with self._notifying:
                self._over = True
                for subscription in self._subscriptions:
                    subscription.close()
            if self._observer is not None:
                self._observer.close()
                if self._observer.failure is not None:
                    log.warning("an observer of the run failed and was told nothing more: %s", self._observer.failure)


CLOSE_WAIT_S = 20.0
"""Wall seconds that a run has to end when the cell is closed."""

Made = TypeVar("Made")


class Runs:
    """The run that goes on, if any, and the stops so far, of the cell called `name`. Callable from any thread."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._beginning = threading.Lock()
        self._run: Run[object] | None = None
        self._stops = 0
        self._stopped: Run[object] | None = None
        self._closed = False

    @property
    def current(self) -> Run[object] | None:
        """The run that is going on, or None."""
        run = self._run
        return None if run is None or run.done else run

    @property
    def stops(self) -> int:
        """How many stops there were so far."""
        return self._stops

    def require_free(self) -> None:
        """Raise `InterlockError` while a run is going on, or when the cell is closed."""
        if self._closed:
            raise InterlockError(self._name, "the cell was closed; open it again")
        if (going := self.current) is not None:
            raise InterlockError(
                self._name, f"a {going.kind} is going on; wait for its end or abort it, then begin again"
            )

    def require_no_late_stop(self) -> None:
        """Raise `Aborted`, once, when the last run was stopped just as it had come to its end."""
        stopped, self._stopped = self._stopped, None
        if stopped is not None and stopped.control.late:
            raise Aborted(
                f"the cell was stopped as the {stopped.kind} before had just ended; nothing was begun. See that it is "
                "safe, then begin the job again"
            )

    def begin(
        self, kind: str, work: Callable[[Run[Made]], Made], observer: Observer | None, stops: int | None
    ) -> Run[Made]:
        """Begin a run if none is going on. `stops` is their count when it was asked for; `Aborted` if another came."""
        with self._beginning:
            self.require_free()
            if stops not in (None, self._stops):
                raise Aborted(f"the cell was stopped before the {kind} began; nothing was begun")
            run = Run(kind, work, observer)
            self._run = run
            return run

    def stop(self) -> None:
        """Count a stop, and end the run that is going on."""
        with self._beginning:
            self._stops += 1
            run = self._stopped = self.current
        if run is not None:
            run.abort("stopped with Cell.stop()")

    def close(self) -> bool:
        """Let no run begin any more; False when that was said before."""
        with self._beginning:
            before, self._closed = self._closed, True
        return not before

    def end(self) -> None:
        """End the run that is going on because the cell is being closed, and wait for its end a while."""
        if (run := self.current) is None:
            return
        run.abort("the cell is being closed")
        try:
            run.ended(CLOSE_WAIT_S)
        except DeadlineError as error:
            log.warning("closing the cell: %s", error)
