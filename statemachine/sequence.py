"""The sequence of the job as data: states, triggers, transitions and the guards on them.

`Sequence` walks through that table with the `transitions` library. Its callbacks only guard and log; no work is done
here, and nothing is known of what a step does. `fault` and `abort` lead out of every state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from functools import partial

from transitions import Machine, MachineError


class State(Enum):
    """Where the job stands."""

    IDLE = "idle"
    DRIVE_TO_TARGET = "drive_to_target"
    BOARD_PHOTO = "board_photo"
    LASER_SWEEP = "laser_sweep"
    RECONSTRUCT = "reconstruct"
    INVERT_POSE = "invert_pose"
    PLACE = "place"
    PLACED = "placed"
    PAUSED = "paused"
    FAULTED = "faulted"
    RECOVERING = "recovering"
    ABORTED = "aborted"
    REFUSED = "refused"


STEPS: tuple[State, ...] = (
    State.DRIVE_TO_TARGET,
    State.BOARD_PHOTO,
    State.LASER_SWEEP,
    State.RECONSTRUCT,
    State.INVERT_POSE,
    State.PLACE,
)
"""The working states, in their order."""

ENDS: tuple[State, ...] = (State.PLACED, State.REFUSED, State.FAULTED, State.ABORTED)
"""The states in which a run can end."""


class Trigger(Enum):
    """What can happen to the job."""

    START = "start"
    NEXT = "next"
    RETRY = "retry"
    PAUSE = "pause"
    RESUME = "resume"
    REFUSE = "refuse"
    FAULT = "fault"
    RECOVER = "recover"
    RECOVERED = "recovered"
    ABORT = "abort"
    RESET = "reset"


class Guard(Enum):
    """Conditions on a transition; the value is what a reader of the diagram sees."""

    ALWAYS = ""
    FIRST_OPEN = "first step not done"
    DONE = "done"
    RETRIES_LEFT = "retries left"
    RECOVERABLE = "recoverable"
    INTERRUPTED = "interrupted step"


@dataclass(frozen=True)
class Transition:
    """`trigger` takes the job from `source` to `target` if `guard` holds."""

    trigger: Trigger
    source: State
    target: State
    guard: Guard = Guard.ALWAYS


def _table() -> tuple[Transition, ...]:
    rows = [Transition(Trigger.START, State.IDLE, step, Guard.FIRST_OPEN) for step in STEPS]
    rows += [
        Transition(Trigger.NEXT, step, after, Guard.DONE)
        for step, after in zip(STEPS, (*STEPS[1:], State.PLACED), strict=True)
    ]
    rows += [Transition(Trigger.RETRY, step, step, Guard.RETRIES_LEFT) for step in STEPS]
    rows += [Transition(Trigger.PAUSE, step, State.PAUSED) for step in STEPS]
    rows += [Transition(Trigger.RESUME, State.PAUSED, step, Guard.INTERRUPTED) for step in STEPS]
    rows += [Transition(Trigger.REFUSE, step, State.REFUSED) for step in (State.IDLE, *STEPS)]
    rows += [Transition(Trigger.RECOVER, State.FAULTED, State.RECOVERING, Guard.RECOVERABLE)]
    rows += [Transition(Trigger.RECOVERED, State.RECOVERING, step, Guard.INTERRUPTED) for step in STEPS]
    rows += [Transition(Trigger.FAULT, state, State.FAULTED) for state in State]
    rows += [Transition(Trigger.ABORT, state, State.ABORTED) for state in State]
    rows += [Transition(Trigger.RESET, end, State.IDLE) for end in ENDS]
    return tuple(rows)


TRANSITIONS: tuple[Transition, ...] = _table()
"""Every transition there is."""


class SequenceError(RuntimeError):
    """A trigger does not lead anywhere from the present state, or its guard does not hold."""


@dataclass
class Facts:
    """What the guards look at; whoever drives the sequence keeps it up to date."""

    done: set[State] = field(default_factory=set)
    interrupted: State | None = None
    retries_left: int = 0
    recoverable: bool = False


ChangeHook = Callable[[Trigger, State, State], None]


class _Model:
    """What `transitions` moves: it sets `state` and adds the method `trigger`."""

    state: State
    trigger: Callable[[str], bool]


class Sequence:
    """The state of one job. `on_change(trigger, source, target)` is called after every change, to log it.

    Not thread-safe: one thread fires the triggers. Reading `state` is safe anywhere.
    """

    def __init__(self, on_change: ChangeHook | None = None) -> None:
        self.facts = Facts()
        self.on_change = on_change
        self._model = _Model()
        # Not queued: a queued trigger returns True even when its guard held it back.
        self._machine = Machine(
            model=self._model, states=State, initial=State.IDLE, auto_transitions=False, queued=False, send_event=False
        )
        for row in TRANSITIONS:
            self._machine.add_transition(
                row.trigger.value, row.source, row.target, conditions=partial(self._holds, row)
            )

    @property
    def state(self) -> State:
        """The present state."""
        return self._model.state

    def fire(self, trigger: Trigger) -> State:
        """Take the transition that `trigger` names and return the new state; `SequenceError` if there is none."""
        source = self.state
        if source in STEPS and trigger in (Trigger.PAUSE, Trigger.FAULT):
            self.facts.interrupted = source
        try:
            moved = self._model.trigger(trigger.value)
        except MachineError as error:
            raise SequenceError(f"'{trigger.value}' leads nowhere from state '{source.value}'") from error
        if not moved:
            guards = {row.guard.value for row in TRANSITIONS if (row.trigger, row.source) == (trigger, source)}
            raise SequenceError(f"'{trigger.value}' is held back in state '{source.value}': not {', '.join(guards)}")
        if trigger is Trigger.RESET:
            self.facts = Facts()
        if self.on_change is not None:
            self.on_change(trigger, source, self.state)
        return self.state

    def allowed(self) -> tuple[Transition, ...]:
        """The transitions that could be taken now."""
        return tuple(row for row in TRANSITIONS if row.source is self.state and self._holds(row))

    def rows(self) -> tuple[Transition, ...]:
        """The transitions as the machine itself holds them, for the diagram."""
        guards = {(row.trigger, row.source, row.target): row.guard for row in TRANSITIONS}
        found = []
        for trigger in Trigger:
            for way in self._machine.get_transitions(trigger.value):
                key = (trigger, State[str(way.source)], State[str(way.dest)])
                found.append(Transition(*key, guards[key]))
        return tuple(found)

    def _holds(self, row: Transition) -> bool:
        facts = self.facts
        match row.guard:
            case Guard.FIRST_OPEN:
                return row.target is next((step for step in STEPS if step not in facts.done), None)
            case Guard.DONE:
                return row.source in facts.done
            case Guard.RETRIES_LEFT:
                return facts.retries_left > 0
            case Guard.RECOVERABLE:
                return facts.recoverable and facts.interrupted is not None and facts.retries_left > 0
            case Guard.INTERRUPTED:
                return row.target is facts.interrupted
        return True
