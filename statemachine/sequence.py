"""The sequence of a job as data: its steps, the states around them, triggers, transitions and the guards on them.

Callbacks only guard and log; no work is done here. `fault` and `abort` lead out of every state.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from functools import partial

from transitions import Machine, MachineError


class JobState(StrEnum):
    """Where a job stands when it is in none of its steps; in a step, its state is the step's name."""

    IDLE = "idle"
    PLACED = "placed"
    DONE = "done"
    PAUSED = "paused"
    FAULTED = "faulted"
    RECOVERING = "recovering"
    ABORTED = "aborted"
    REFUSED = "refused"
    MISPLACED = "misplaced"


class JobTrigger(Enum):
    """What can happen to the job."""

    START = "start"
    NEXT = "next"
    RETRY = "retry"
    AGAIN = "again"
    PAUSE = "pause"
    RESUME = "resume"
    REFUSE = "refuse"
    MISPLACE = "misplace"
    FAULT = "fault"
    RECOVER = "recover"
    RECOVERED = "recovered"
    ABORT = "abort"


class TransitionGuard(Enum):
    """Conditions on a transition; the value is what a reader of the diagram sees."""

    ALWAYS = ""
    DONE = "done"
    RETRIES_LEFT = "retries left"
    RECOVERABLE = "recoverable"
    INTERRUPTED = "interrupted step"
    CHOSEN = "chosen step"


@dataclass(frozen=True)
class Transition:
    """`trigger` takes the job from `source` to `target` if `guard` holds."""

    trigger: JobTrigger
    source: str
    target: str
    guard: TransitionGuard = TransitionGuard.ALWAYS


def table(steps: tuple[str, ...], success: JobState) -> tuple[Transition, ...]:
    """Every transition of a job with these steps, which ends in `success` when all are done."""
    around = [state for state in JobState if state is success or state not in (JobState.PLACED, JobState.DONE)]
    states = [*around, *steps]
    rows = [Transition(JobTrigger.START, JobState.IDLE, steps[0])]
    rows += [
        Transition(JobTrigger.NEXT, step, after, TransitionGuard.DONE)
        for step, after in zip(steps, (*steps[1:], success), strict=True)
    ]
    rows += [Transition(JobTrigger.RETRY, step, step, TransitionGuard.RETRIES_LEFT) for step in steps]
    rows += [
        Transition(JobTrigger.AGAIN, step, earlier, TransitionGuard.CHOSEN)
        for k, step in enumerate(steps)
        for earlier in steps[: k + 1]
    ]
    rows += [Transition(JobTrigger.PAUSE, step, JobState.PAUSED) for step in steps]
    rows += [Transition(JobTrigger.RESUME, JobState.PAUSED, step, TransitionGuard.INTERRUPTED) for step in steps]
    rows += [Transition(JobTrigger.REFUSE, step, JobState.REFUSED) for step in (JobState.IDLE, *steps)]
    rows += [Transition(JobTrigger.MISPLACE, step, JobState.MISPLACED) for step in steps]
    rows += [Transition(JobTrigger.RECOVER, JobState.FAULTED, JobState.RECOVERING, TransitionGuard.RECOVERABLE)]
    rows += [Transition(JobTrigger.RECOVERED, JobState.RECOVERING, step, TransitionGuard.INTERRUPTED) for step in steps]
    rows += [Transition(JobTrigger.FAULT, state, JobState.FAULTED) for state in states]
    rows += [Transition(JobTrigger.ABORT, state, JobState.ABORTED) for state in states]
    return tuple(rows)


class SequenceError(RuntimeError):
    """A trigger does not lead anywhere from the present state, or its guard does not hold."""


@dataclass
class Facts:
    """What the guards look at; whoever drives the sequence keeps it up to date."""

    done: set[str] = field(default_factory=set)
    interrupted: str | None = None
    chosen: str | None = None
    retries_left: int = 0
    recoverable: bool = False


ChangeHook = Callable[[JobTrigger, str, str], None]


class _Model:
    """What `transitions` moves: it sets `state` and adds the method `trigger`."""

    state: str
    trigger: Callable[[str], bool]


class Sequence:
    """The state of one job with these `steps`. `on_change(trigger, source, target)` is called after every change.

    `success` is the state in which it ends when all are done. Not thread-safe: one thread fires the triggers. Reading
    `state` is safe anywhere. Raises ValueError when two steps have one name, or one that of a state.
    """

    def __init__(
        self, steps: tuple[str, ...], success: JobState = JobState.PLACED, on_change: ChangeHook | None = None
    ) -> None:
        if not steps or len(set(steps)) < len(steps) or set(steps) & set(JobState):
            raise ValueError(f"steps need names of their own, other than {', '.join(JobState)}; given: {list(steps)}")
        self.steps = steps
        self.success = success
        self.facts = Facts()
        self.on_change = on_change
        self.table = table(steps, success)
        self._model = _Model()
        # Not queued: a queued trigger returns True even when its guard held it back.
        self._machine = Machine(
            model=self._model,
            states=list(dict.fromkeys(str(row.source) for row in self.table)),
            initial=JobState.IDLE.value, auto_transitions=False, queued=False, send_event=False,
        )  # fmt: skip
        for row in self.table:
            self._machine.add_transition(
                row.trigger.value, str(row.source), str(row.target), conditions=partial(self._holds, row)
            )

    @property
    def state(self) -> str:
        """The present state: a step's name, or a `JobState`."""
        return self._model.state

    def fire(self, trigger: JobTrigger) -> str:
        """Take the transition that `trigger` names and return the new state; `SequenceError` if there is none."""
        source = self.state
        if source in self.steps and trigger in (JobTrigger.PAUSE, JobTrigger.FAULT):
            self.facts.interrupted = source
        try:
            moved = self._model.trigger(trigger.value)
        except MachineError as error:
            raise SequenceError(f"'{trigger.value}' leads nowhere from state '{source}'") from error
        if not moved:
            guards = {row.guard.value for row in self.table if (row.trigger, row.source) == (trigger, source)}
            raise SequenceError(f"'{trigger.value}' is held back in state '{source}': not {', '.join(guards)}")
        if trigger is JobTrigger.AGAIN:
            self.facts.done -= set(self.steps[self.steps.index(self.state) :])
            self.facts.chosen = None
        if self.on_change is not None:
            self.on_change(trigger, source, self.state)
        return self.state

    def _holds(self, row: Transition) -> bool:
        facts = self.facts
        match row.guard:
            case TransitionGuard.DONE:
                return row.source in facts.done
            case TransitionGuard.RETRIES_LEFT:
                return facts.retries_left > 0
            case TransitionGuard.RECOVERABLE:
                return facts.recoverable and facts.interrupted is not None and facts.retries_left > 0
            case TransitionGuard.INTERRUPTED:
                return row.target == facts.interrupted
            case TransitionGuard.CHOSEN:
                return row.target == facts.chosen
        return True
