"""Work outside a job as a recorded run: calibration, verification, homing, jogs.

It has a folder, a journal and a report like a job's run, listens to the same requests, and whatever ends it early stops
the cell first.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from cell.config import CellConfig
from cell.devices.devices import Devices
from cell.devices.stopping import require_healthy, stop_not_confirmed
from cell.record.recorder import begin_record
from cell.run.folder import REPORT, new_run, timeless, when
from cell.run.frames import FrameStore
from cell.run.logs import run_log
from cell.run.run import Run
from cell.storage import sealed, write_json
from cell.version import release
from drivers.errors import Aborted, CellError, Interrupted, RefusedError
from drivers.interfaces import Frame
from statemachine.journal import Journal, JournalError
from statemachine.step import Event
from statemachine.waiting import waiting_on

GRACE_S = 5.0
"""Wall seconds that stopped work has to end."""
REQUEST_POLLS, HEALTH_POLLS = 10, 5
"""At every so many looks around: requests of other processes, the cell's health."""

FRAMES = "frames"
"""Where in the run's folder the pictures are that its work looked at."""

Made = TypeVar("Made")

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Hands:
    """What work is given to be held by: `check` raises once it is to end, `safe_point` also holds it when paused.

    `keep(what, frame)` leaves a picture that the work looked at in the run's folder.
    """

    check: Callable[[], None]
    safe_point: Callable[[], None]
    progress: Callable[[float, str], None]
    keep: Callable[[str, Frame], None]


@dataclass(frozen=True, eq=False)
class RecordedWork:
    """Work of one kind on the cell's devices, recorded below `root`; `info` goes into the journal and the report.

    Without the `config` of the cell the devices' own doings are not recorded.

    `health(devices)` is called about ten times a second, and raises what must end the work whatever it does.
    """

    run: Run[Any]
    kind: str
    devices: Devices
    root: Path
    info: Mapping[str, Any]
    health: Callable[[Devices], None] = require_healthy
    config: CellConfig | None = None

    def perform(self, work: Callable[[Hands], Made]) -> Made:
        """Do `work` and record how it ended.

        Raises `Aborted` when the run was ended (`Interrupted` by a signal), `DeviceFault` when the stop was not
        confirmed, else what `work` raised; the cell is stopped first.
        """
        started, begun = time.time(), self.devices.clock.now()
        try:
            folder = new_run(self.root)
            facts = {"kind": self.kind, "pid": os.getpid(), **self.info}
            journal = Journal(folder, folder.name, facts)
        except (OSError, JournalError) as error:
            raise CellError(f"no run can be recorded in {self.root}: {error}") from error
        outer, self.run.folder = self.run.folder, folder
        outcome, reason = "done", f"{self.kind} done"
        ended: BaseException | None = None
        record = None if self.config is None else begin_record(folder, self.run, self.config, self.devices)
        frames = self.run.frames = FrameStore(folder / FRAMES, None if record is None else record.frame)
        try:
            with run_log(folder), frames:
                return self._watched(work, journal, frames)
        except BaseException as error:
            ended, outcome, reason = error, _outcome(error), str(error)
            raise
        finally:
            if self.run.kind == self.kind:
                self.run.tell(Event("run_ended", self.kind, {"outcome": outcome, "reason": reason}))
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

    def _watched(self, work: Callable[[Hands], Made], journal: Journal, frames: FrameStore) -> Made:
        control, clock = self.run.control, self.devices.clock
        waiting = waiting_on(clock)
        hands = Hands(
            control.token.check,
            lambda: control.safe_point(control.token, self._say, waiting.look),
            self._progress,
            frames.keep,
        )
        made: list[Made] = []
        problems: list[str] = []
        asked: str | None = None
        ailing: Exception | None = None
        stopped = False
        polls = 0

        def begin() -> None:
            with self.devices.gate.entered(control.token):
                control.token.check()
                made.append(work(hands))

        def stop(why: str) -> None:
            nonlocal stopped
            stopped = True
            control.token.cancel(why)
            problems.extend(self.devices.stop())

        def cut() -> str | None:
            nonlocal asked, ailing, polls
            polls += 1
            try:
                if polls % REQUEST_POLLS == 0:
                    control.obey(journal.take_requests())
                if polls % HEALTH_POLLS == 0:
                    self.health(self.devices)
            # Whatever keeps it from being watched ends the work; it must not go on unseen.
            except Exception as found:
                ailing = found
            asked = control.token.reason
            why = asked or (None if ailing is None else str(ailing))
            if why is not None:
                stop(why)
            return why

        key = journal.step_started(self.kind, 1)
        begun = clock.now()
        call = waiting.do(self.kind, begin, cut, GRACE_S)
        error = ailing or call.error
        if not stopped:
            asked = control.token.reason
            if asked is not None or error is not None:
                stop(asked or str(error))
        if not call.done.is_set():
            problems.append(f"the {self.kind} was still busy {GRACE_S:g} s after the stop")
        said = asked or (None if error is None else str(error))
        _last(lambda: journal.step_ended(key, clock.now() - begun, error=said), error)
        unconfirmed = f"; not confirmed: {'; '.join(problems)}" if problems else ""
        if asked is not None:
            text = f"{self.kind} {asked}" if control.signal is not None else f"{self.kind} ended: {asked}"
            kind = Interrupted if control.signal is not None else Aborted
            raise kind(f"{text}; the cell was stopped{unconfirmed}")
        if error is not None and problems:
            raise stop_not_confirmed(f"{self.kind}: {error}{unconfirmed}") from error
        if error is not None:
            raise error
        return made[0]

    def _progress(self, fraction: float, text: str) -> None:
        self.run.control.token.check()
        self.run.tell(Event("progress", self.kind, {"fraction": fraction, "text": text}))

    def _say(self, held: bool) -> None:
        text = "held before its next motion" if held else "goes on"
        self.run.tell(Event("paused" if held else "going_on", self.kind, {"text": text}))


def _last(action: Callable[[], object], ended: BaseException | None) -> None:
    """Do `action` at the end; should it fail, that is noted on what the work `ended` with, and replaces nothing."""
    try:
        action()
    except (JournalError, OSError, CellError) as error:
        log.warning("the end could not be recorded: %s", error)
        if ended is not None:
            ended.add_note(f"and the end could not be recorded: {error}")


def _outcome(error: BaseException) -> str:
    if isinstance(error, Aborted):
        return "aborted"
    return "refused" if isinstance(error, RefusedError) else "faulted"
