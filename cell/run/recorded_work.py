"""Work outside a job as a recorded run (calibration, homing, jogs), and what an error means for any run.

It has a folder, a journal and a report like a job's run, and listens to the same requests. It asks the same question
after a protective stop, and whatever ends it early stops the cell first.
"""

import logging
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from cell.base.lateness import LATENESS, MOST_S
from cell.base.storage import sealed, write_json
from cell.config.cell_config import CellConfig
from cell.devices.devices import Devices, require_healthy, stop_not_confirmed
from cell.devices.simulated.following import DeviceFollowing
from cell.procedures.frame_store import FrameStore
from cell.run.folder import REPORT, new_folder, release, run_log, timeless, when
from cell.run.record.recorder import begin_record
from cell.run.runs import Run
from drivers import errors
from drivers.interfaces import Frame
from statemachine.control import CancelToken
from statemachine.journal import Journal, JournalError
from statemachine.runner import LoneResult, Runner
from statemachine.sequence import JobState, Sequence
from statemachine.step import Event, Failure, Outcome, Policy, Step, StepContext

CONFIRMED_BY_A_PERSON = frozenset(("arm.protective_stop",))
"""Faults that no program may clear by itself: the maker asks that a person looks at the arm first."""


UNHEARD = frozenset(("arm.link_lost", "arm.program_stopped"))
"""Faults of a device that was not heard, or did not hear, in time."""
BUSY = "this computer is too busy"


def classify(error: BaseException, following: DeviceFollowing | None = None) -> Failure:
    """What an exception means for the run; what failed besides, as it was ended, is told after it. What a person is
    asked says what is simulated beside real devices (`following`)."""
    failure = _classify(error)
    if notes := getattr(error, "__notes__", ()):
        failure = replace(failure, reason="; ".join([failure.reason, *notes]))
    unheard = isinstance(error, errors.DeadlineError | errors.NotConnectedError) or failure.code in UNHEARD
    hurried = LATENESS.rate > 1.0 and isinstance(error, errors.RefusedError | errors.DeviceFault)
    if (unheard or hurried) and (late := LATENESS.worst) > MOST_S and BUSY not in failure.reason:
        said = f"{failure.reason.rstrip('.')}. {BUSY.capitalize()}: it woke up {1e3 * late:.0f} ms late."
        if LATENESS.rate > 1.0:
            said += (
                f" The simulated cell keeps {LATENESS.rate:g} times the wall's pace: `--speed 1` gives it more time, "
            )
            said += "`--clock virtual` all that it needs."
        failure = replace(failure, reason=said)
    if not failure.needs_person or following is None:
        return failure
    names = ", ".join(following.simulated)
    return replace(failure, reason=f"{failure.reason} (simulated here: {names}; all else is real)")


def _classify(error: BaseException) -> Failure:
    match error:
        case errors.MisplacedError():
            return Failure(Outcome.MISPLACED, str(error), type(error).__name__, error=error)
        case errors.RefusedError() | errors.CalibrationStale() | errors.ConfigError():
            return Failure(Outcome.REFUSED, str(error), type(error).__name__, error=error)
        case errors.Aborted():
            return Failure(Outcome.ABORTED, str(error), "aborted")
        case errors.DeviceFault():
            person = error.code in CONFIRMED_BY_A_PERSON
            return Failure(Outcome.FAULTED, str(error), error.code, error.recoverable, person)
        case errors.CellError():
            return Failure(Outcome.FAULTED, str(error), type(error).__name__)
    return Failure(Outcome.FAULTED, f"unexpected {type(error).__name__}: {error}", "internal")


def clear(devices: Devices, error: BaseException, token: CancelToken, confirmed: bool) -> None:
    """Clear the fault of a device, as far as a program may; a camera or the rail only needs its work done again."""
    with devices.gate.entered(token):
        token.check()
        if isinstance(error, errors.DeviceError) and error.device in ("arm", "laser", "claw"):
            devices.arm.recover(confirmed=confirmed)
        elif isinstance(error, errors.DeviceError) and error.device == "vehicle":
            devices.vehicle.recover()


GRACE_S = 5.0
"""Wall seconds that stopped work has to end."""
RETRIES = 3
"""How often at most the work is done again after a fault was cleared."""

FRAMES = "frames"
"""Where in the run's folder the pictures are that its work looked at."""

Made = TypeVar("Made")

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class WorkContext:
    """What work is given to be held by: `check` raises once it is to end, `safe_point` also holds it when paused.
    `keep(what, frame)` leaves a picture that the work looked at in the run's folder. `ask(what)` waits for a person."""

    check: Callable[[], None]
    safe_point: Callable[[], None]
    progress: Callable[[float, str], None]
    keep: Callable[[str, Frame], None]
    ask: Callable[[str], None]


@dataclass(frozen=True, eq=False)
class RecordedWork:
    """Work of one kind on the cell's devices, recorded below `root`; `info` goes into the journal and the report.

    Without the `config` of the cell the devices' own doings are not recorded.
    `health(devices)` is called about ten times a second, and raises what must end the work whatever it does.
    """

    run: Run[object]
    kind: str
    devices: Devices
    root: Path
    info: Mapping[str, object]
    health: Callable[[Devices], None] = require_healthy
    config: CellConfig | None = None

    def perform(self, work: Callable[[WorkContext], Made]) -> Made:
        """Do `work` and record how it ended. Raises `Aborted` when the run was ended (`Interrupted` by a signal),
        `DeviceFault` when the stop was not confirmed, else what `work` raised; the cell is stopped first."""
        started, begun = time.time(), self.devices.clock.now()
        with new_folder(self.root) as folder:
            facts = {"kind": self.kind, "pid": os.getpid(), **self.info}
            journal = Journal(folder, folder.name, facts)
        outer, self.run.folder = self.run.folder, folder
        outcome, reason = "done", f"{self.kind} done"
        ended: BaseException | None = None
        record = None if self.config is None else begin_record(folder, self.run, self.config, self.devices)
        kept = self.config is None or self.config.cell.frames
        frames = self.run.frames = FrameStore(folder / FRAMES, None if record is None else record.frame, kept=kept)
        try:
            with run_log(folder), frames:
                return self._watched(work, journal, frames)
        except BaseException as error:
            ended, outcome, reason = error, outcome_of(error), str(error)
            raise
        finally:
            if self.run.kind == self.kind:
                self.run.notify(Event("run_ended", self.kind, {"outcome": outcome, "reason": reason}))
            if record is not None:
                record.close()
            report = {
                "run": folder.name, "version": release(), "outcome": outcome, "reason": reason,
                "started": when(started), "ended": when(time.time()), "wall_s": round(time.time() - started, 2),
                "cell_s": round(self.devices.clock.now() - begun, 3), **facts,
            }  # fmt: skip
            if outcome != "done" and frames.recent:
                report["last_frames"] = [f"{FRAMES}/{name}" for name in frames.recent]
            if frames.failure is not None:
                report["frames_missing"] = frames.failure
            for action in (
                lambda: journal.run_ended(outcome, reason), journal.close,
                lambda: write_json(folder / REPORT, sealed(timeless(report))),
            ):  # fmt: skip
                _last(action, ended)
            self.run.folder = outer or folder

    def _watched(self, work: Callable[[WorkContext], Made], journal: Journal, frames: FrameStore) -> Made:
        """Do it under the same watch as a job's step: a fault that a person may clear is asked about, then it is done
        again from its beginning."""
        devices = self.devices
        safe_stop, stops, open_before = _SafeStop(devices), 0, devices.gate.is_open

        def begin(context: StepContext) -> Made:
            nonlocal stops
            with devices.gate.entered(context.token):
                context.check()
                devices.forget_ambient_light()
                given = WorkContext(context.check, context.safe_point, context.progress, frames.keep, context.ask)
                made = work(given)
            # A stop that a person asks for from here on is not cleared.
            stops = devices.gate.stops
            return made

        simulated = self.config is not None and self.config.cell.confirm == "simulated"
        runner = Runner(
            sequence=Sequence((self.kind,), JobState.DONE), steps={self.kind: begin},
            policy=Policy((Step(self.kind, math.inf, RETRIES),), grace_s=GRACE_S, simulated_person=simulated),
            journal=journal, clock=devices.clock, classify=self._classify, safe_stop=safe_stop, observer=self._heard,
            recover=partial(clear, devices), health=lambda: self.health(devices), control=self.run.control,
        )  # fmt: skip
        result = runner.run_alone()
        if result.unrecorded is not None:
            log.warning("the %s could not be recorded: %s", self.kind, result.unrecorded)
        if result.end is not None:
            raise self._ended(result.end, result, safe_stop.problems)
        if open_before and safe_stop.called:
            # The stops of attempts that were recovered from keep nobody from going on.
            devices.gate.clear(stops)
        made: Made = result.made  # type: ignore[assignment]
        return made

    def _ended(self, end: Failure, result: LoneResult, problems: list[str]) -> BaseException:
        """What the end of work is raised as: its own error, unless somebody asked for it or the stop failed."""
        control, error = self.run.control, result.error
        if result.abandoned:
            problems = [*problems, f"the {self.kind} was still busy {GRACE_S:g} s after the stop"]
        unconfirmed = f"; not confirmed: {'; '.join(problems)}" if problems else ""
        if (asked := control.token.reason) is not None:
            text = f"{self.kind} {asked}" if control.signal is not None else f"{self.kind} ended: {asked}"
            kind = errors.Interrupted if control.signal is not None else errors.Aborted
            return kind(f"{text}; the cell was stopped{unconfirmed}")
        if problems or error is None:
            fault = stop_not_confirmed(f"{self.kind}: {end.reason}{unconfirmed}")
            fault.__cause__ = error
            return fault
        if isinstance(error, errors.CellError) and result.judged is not None and end.reason != result.judged.reason:
            # Nobody confirmed it, or it could not be cleared.
            error.args = (end.reason,)
        return error

    def _classify(self, error: BaseException) -> Failure:
        """As `classify`. Only what a person confirms is cleared, and a lost link to the arm where nothing is jogged."""
        failure = classify(error, self.devices.following)
        lost = failure.code in ("arm.link_lost", "arm.link_closed") and self.kind != "jog"
        return replace(failure, recoverable=failure.recoverable and (failure.needs_person or lost))

    def _heard(self, event: Event) -> None:
        # Steps and states are those of a job.
        if not event.kind.startswith(("step_", "state")):
            self.run.notify(event)


@dataclass(eq=False)
class _SafeStop:
    """Brings the cell to rest; `problems` are what the newest stop did not confirm."""

    devices: Devices
    called: bool = False
    problems: list[str] = field(default_factory=list)

    def __call__(self, reason: str) -> None:
        self.called = True
        self.problems = ["the safe stop did not end"]
        self.problems = self.devices.stop()


def _last(action: Callable[[], object], ended: BaseException | None) -> None:
    """Do `action` at the end; should it fail, that is noted on what the work `ended` with, and replaces nothing."""
    try:
        action()
    except (JournalError, OSError, errors.CellError) as error:
        log.warning("the end could not be recorded: %s", error)
        if ended is not None:
            ended.add_note(f"and the end could not be recorded: {error}")


def outcome_of(error: BaseException) -> str:
    """How a run ended that this error ended, in the report's word."""
    if isinstance(error, errors.Aborted):
        return "aborted"
    return "refused" if isinstance(error, errors.RefusedError) else "faulted"
