"""What a run tells while it goes on, as typed events with their time, and subscriptions that cannot slow it.

A subscriber that does not keep up loses only progress: of each step it then finds the newest. What is not progress is
kept for it up to a bound; the journal has everything.
"""

import inspect
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from statemachine.step import Event

MOST_WAITING = 1000
"""Events that wait for one subscriber; beyond that the oldest is let go."""


@dataclass(frozen=True)
class RunEvent:
    """Base of all events; `at` is in seconds since the epoch, `step` the step or work that it is about, if any."""

    at: float
    step: str | None


@dataclass(frozen=True)
class StateChanged(RunEvent):
    """The sequence went from one state to another."""

    trigger: str
    source: str
    target: str


@dataclass(frozen=True)
class StepStarted(RunEvent):
    """An attempt at a step began, counted from 1."""

    attempt: int


@dataclass(frozen=True)
class StepProgress(RunEvent):
    """How far a step is, 0 to 1, and what it does now."""

    fraction: float
    text: str


@dataclass(frozen=True)
class StepDone(RunEvent):
    """A step has succeeded; `summary` are its figures."""

    duration_s: float
    summary: Mapping[str, object]


@dataclass(frozen=True)
class StepFailed(RunEvent):
    """An attempt at a step has failed."""

    attempt: int
    reason: str


@dataclass(frozen=True)
class FaultMet(RunEvent):
    """A fault, and what was done about it."""

    code: str
    reason: str
    remedy: str


@dataclass(frozen=True)
class SafeStopped(RunEvent):
    """The cell was brought to rest; `trouble` says what was not confirmed."""

    reason: str
    trouble: str | None


@dataclass(frozen=True)
class ConfirmNeeded(RunEvent):
    """The run waits for a person's word about this: `Run.confirm(by, number)` or `cell confirm`."""

    reason: str
    code: str
    number: int


@dataclass(frozen=True)
class Confirmed(RunEvent):
    """Somebody confirmed."""

    by: str
    reason: str


@dataclass(frozen=True)
class Held(RunEvent):
    """The run is paused and stands at a safe point."""

    text: str


@dataclass(frozen=True)
class GoesOn(RunEvent):
    """A paused run goes on."""

    text: str


@dataclass(frozen=True)
class Noted(RunEvent):
    """Something worth keeping."""

    data: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class RunEnded(RunEvent):
    """The run has ended."""

    outcome: str
    reason: str


TYPED: Mapping[str, Callable[..., RunEvent]] = {
    "step_started": StepStarted, "progress": StepProgress, "step_failed": StepFailed, "fault": FaultMet,
    "safe_stop": SafeStopped, "confirm_needed": ConfirmNeeded, "confirmed": Confirmed, "paused": Held,
    "going_on": GoesOn, "run_ended": RunEnded,
}  # fmt: skip
"""Of each kind of the runner's events, its class: the data go by the names of its fields."""


def typed(event: Event) -> RunEvent:
    """The typed form of an event of the runner."""
    at, step, data = event.at, event.step, dict(event.data)
    match event.kind:
        case "state":
            return StateChanged(at, step, str(data["trigger"]), str(data["from"]), str(data["to"]))
        case "step_done":
            return StepDone(at, step, float(str(data.pop("duration_s"))), data)
        case "fault":
            data.setdefault("remedy", "noted")
    if (made := TYPED.get(event.kind)) is None:
        return Noted(at, step, data)
    return made(at, step, **{name: data[name] for name in list(inspect.signature(made).parameters)[2:]})


class Subscription:
    """One listener's queue of a run's events. The run puts them in and never waits."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._waiting: deque[Event] = deque()
        self._closed = False

    def put(self, event: Event) -> None:
        """An event happened."""
        with self._news:
            if self._closed:
                return
            if event.kind == "progress":
                last = self._waiting[-1] if self._waiting else None
                if last is not None and (last.kind, last.step) == ("progress", event.step):
                    self._waiting.pop()
            self._waiting.append(event)
            if len(self._waiting) > MOST_WAITING:
                stale = next((old for old in self._waiting if old.kind == "progress"), self._waiting[0])
                self._waiting.remove(stale)
            self._news.notify_all()

    def close(self) -> None:
        """No more events will come; those that wait can still be taken."""
        with self._news:
            self._closed = True
            self._news.notify_all()

    def take(self, timeout: float | None = None) -> Event | None:
        """The next event; None when the run has ended and all were taken, or after `timeout` wall seconds."""
        with self._news:
            self._news.wait_for(lambda: self._waiting or self._closed, timeout)
            return self._waiting.popleft() if self._waiting else None

    @property
    def closed(self) -> bool:
        """Whether no more events will come."""
        return self._closed

    def __iter__(self) -> Iterator[RunEvent]:
        while (event := self.take()) is not None:
            yield typed(event)


class Detached:
    """An observer that is told in a thread of its own, so that it cannot slow the run. One that fails is told nothing
    more; `failure` then says why."""

    def __init__(self, observer: Callable[[Event], None]) -> None:
        self.failure: str | None = None
        self._observer = observer
        self._events = Subscription()
        self._thread = threading.Thread(target=self._notify, name="observer", daemon=True)
        self._thread.start()

    def __call__(self, event: Event) -> None:
        """Take an event of the runner."""
        self._events.put(event)

    def close(self, timeout: float = 2.0) -> None:
        """Let it hear what is left, for at most `timeout` wall seconds."""
        self._events.close()
        self._thread.join(timeout)

    def _notify(self) -> None:
        while (event := self._events.take()) is not None:
            try:
                self._observer(event)
            except Exception as error:
                self.failure = f"{type(error).__name__}: {error}"
                self._events.close()
                return
