"""A runner on a journal in a folder, whose steps a test sets: for tests of the runner, attempts and the watch."""

import threading
from dataclasses import replace

from drivers.clock import Clock
from statemachine.journal import Journal, read
from statemachine.runner import Runner
from statemachine.sequence import Sequence
from statemachine.step import Failure, OnFailure, Outcome, Policy, Step

NAMES = ["drive_to_target", "board_photo", "laser_sweep", "reconstruct", "invert_pose", "place"]
POLICY = Policy(
    (
        Step("drive_to_target", 180.0, 1, ("DeadlineError",)),
        Step("board_photo", 60.0, 2, ("DeadlineError",)),
        Step("laser_sweep", 120.0, 2, ("DeadlineError",)),
        Step("reconstruct", 60.0, on_wall=True),
        Step("invert_pose", 60.0, on_wall=True),
        Step("place", 180.0, on_failure=OnFailure.STOP),
    )
)


class Bench:
    """It notes what happened, in order. `given` are the steps' work, by name, and what the runner is given besides.
    `unconfirmed` is how the reason of a safe stop begins that cannot be confirmed."""

    def __init__(self, folder, unconfirmed=None, **given):
        self.folder = folder
        self.log = []
        self.stopped = threading.Event()
        self.events = []
        self.on_stop = lambda: None
        self.unconfirmed = unconfirmed
        work = {name: self._step(name, given.pop(name, None)) for name in NAMES}
        self.runner = Runner(
            sequence=Sequence(tuple(NAMES)), steps=work, policy=replace(POLICY, grace_s=1.0, stop_deadline_s=1.0),
            journal=Journal(folder, "r1"), classify=self.classify, safe_stop=self.safe_stop,
            **{"clock": Clock(), "observer": self.events.append, **given},
        )  # fmt: skip
        self.control = self.runner.control

    def _step(self, name, work):
        def step(context):
            self.log.append(name)
            return work(context) if work is not None else f"made by {name}"

        return step

    def classify(self, error):
        if isinstance(error, ValueError):
            return Failure(Outcome.REFUSED, str(error), "refused")
        return Failure(
            Outcome.FAULTED, str(error), "fault", recoverable=isinstance(error, ConnectionError),
            needs_person=isinstance(error, ConnectionRefusedError),
        )  # fmt: skip

    def safe_stop(self, reason):
        self.on_stop()
        self.log.append(f"stop: {reason}")
        self.stopped.set()
        if self.unconfirmed is not None and reason.startswith(self.unconfirmed):
            raise OSError("vehicle stopped and braked: not confirmed")

    def policy(self, *args, **values):
        """Another policy of a step."""
        step = Step(*args, **values)
        return self.times(steps=tuple(step if old.name == step.name else old for old in self.runner.policy.steps))

    def times(self, **values):
        """Other times of the whole policy."""
        self.runner.policy = replace(self.runner.policy, **values)
        return self

    def recovers(self):
        """Recoveries succeed, and are noted."""
        self.runner.recover = lambda error, token, confirmed: self.log.append(f"recover: {error}, {confirmed}")
        return self

    @property
    def recovered(self):
        """Whether a recovery began."""
        return any(line.startswith("recover") for line in self.log)

    def told(self, kind):
        """The data of the events of a kind that the observer was told."""
        return [dict(event.data) for event in self.events if event.kind == kind]

    def run(self):
        result = self.runner.run()
        self.record = read(self.folder)
        assert self.log[-1].startswith("stop: end of the run"), "the last thing is always the safe stop"
        assert sum(line.startswith("stop: end of the run") for line in self.log) == 1
        assert self.record.run.outcome == result.outcome.value
        assert self.runner.sequence.state == result.outcome.value
        return result


def failing(*errors):
    """A step that raises the errors one after the other and then succeeds."""
    left = list(errors)

    def work(context):
        if left:
            raise left.pop(0)
        return f"made in attempt {context.attempt}"

    return work
