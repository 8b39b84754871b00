"""What a job's run does around the steps: a calibration first where there is none, and the sweep of a run before."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import DEVICES
from cell.devices.simulated.mix import beware
from cell.devices.simulated.process import is_whole
from cell.run import calibration as sessions
from cell.run.files.reading import read_report
from cell.run.job_run import JobRun, Observer, RunOutcome
from cell.run.ready_job import ReadyJob
from cell.run.recorded_work import outcome_of
from cell.run.report.figures import following_words
from cell.run.resumption import UnfinishedRun
from cell.run.run import Run
from cell.run.session.session import Opened
from statemachine.runner import Event


@dataclass(frozen=True, eq=False)
class JobWork:
    """A job, read as `ready` from `file`, for a run of this cell; `info` goes into the journal and the report.

    `stored` is its calibration; without one it is calibrated first. `before` is the run that this one resumes,
    `at_start` somebody's word that the vehicle stands at the job's start pose, for this run alone.
    """

    cell: Opened
    file: str | Path
    ready: ReadyJob
    info: Mapping[str, Any]
    stored: CellCalibration | None
    before: UnfinishedRun | None
    inline: tuple[Observer, ...]
    at_start: bool

    def perform(self, run: Run[RunOutcome]) -> RunOutcome:
        """Do it; raises what `JobRun.perform` raises. Ended as any run where the calibration before it ends it."""
        cell, ready = self.cell, self.ready

        def note(text: str) -> None:
            run.tell(Event("note", None, {"text": text}))

        if (simulated := cell.simulated) is not None and not is_whole(simulated):
            for sentence in beware(simulated.simulated, DEVICES):
                note(sentence)
            if (following := cell.devices.following) is not None:
                note(f"readings reach the simulated world after: {following_words(following.figures())}")
        if self.at_start:
            cell.whereabouts.say_at_start()
        calibration = self.stored
        if calibration is None:
            note("this simulated cell has no calibration yet: calibrating first")
            begun = time.time()
            try:
                calibration = sessions.calibrate(cell, run, self.file)
            except Exception as error:
                return self._uncalibrated(run, error, time.time() - begun)
        earlier = None
        if self.before is not None:
            earlier, why = self.before.sweep(ready.job, cell.config, calibration)
            note(why if earlier is not None else f"{why}: sweeping again")
        job_run = JobRun(
            run,
            cell.config,
            cell.devices,
            job=ready.job,
            nominal=ready.nominal,
            calibration=calibration,
            info=self.info,
            kind=ready.kind,
            script=ready.script,
            inline=self.inline,
            earlier=earlier,
            truth=cell.truth,
            pace=cell.pace,
        )
        try:
            return job_run.perform(cell.runs_folder, cell.whereabouts)
        finally:
            if self.at_start:
                cell.whereabouts.forget_word()

    def _uncalibrated(self, run: Run[RunOutcome], error: Exception, wall_s: float) -> RunOutcome:
        """How a job ended whose first calibration ended with this error; its report is the calibration's."""
        if run.folder is None:
            raise error
        run.control.over = True
        outcome, reason = outcome_of(error), f"in the calibration before the job: {error}"
        run.tell(Event("run_ended", None, {"outcome": outcome, "reason": reason}))
        report = {**read_report(run.folder), "outcome": outcome, "reason": reason}
        return RunOutcome(outcome, reason, run.folder, report, control=run.control, wall_s=wall_s)
