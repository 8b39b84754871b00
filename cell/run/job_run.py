"""One job as a recorded run: read and checked, calibrated for if need be, run, and reported."""

import logging
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import pinocchio as pin

from cell.base.storage import write_json
from cell.check.fit import require_fit
from cell.check.place import mesh_box
from cell.config.calibrations.store import CellCalibration, save_calibration
from cell.config.cell_config import DEVICES, CellConfig
from cell.config.job import Job, load_job
from cell.devices.devices import Devices, require_healthy, stop_cell
from cell.devices.simulated.following import DeviceFollowing
from cell.devices.simulated.mixed import beware
from cell.devices.simulated.process import Injector, is_whole
from cell.measure.inversion import NominalSurface
from cell.procedures.arm.moves import Pace, PartProgress, PartState
from cell.procedures.drive.way import Whereabouts
from cell.procedures.frame_store import FrameStore
from cell.procedures.sought_part import ground_below, nominal_of, sought
from cell.procedures.steps import pick, place, verify
from cell.procedures.steps.kinds import Kind, kind_of
from cell.procedures.steps.pick import HeldPart
from cell.procedures.steps.workplace import PartsBefore, Workplace
from cell.procedures.sweep.stored_sweep import StoredSweep
from cell.procedures.sweep.swath import SweepCollector, Sweeping
from cell.run import calibration as sessions
from cell.run.folder import new_folder, read_report, run_log
from cell.run.record.recorder import Recorder, recorded
from cell.run.record.replay import save as save_perception
from cell.run.recorded_work import classify, clear, outcome_of
from cell.run.report.evidence import seen_words
from cell.run.report.figures import following_words
from cell.run.report.report import FinishedJob, TruthRecorder
from cell.run.resumption import UnfinishedRun, job_source
from cell.run.runs import Run
from cell.run.session.session import OpenCell
from drivers.errors import CalibrationStale, CellError
from drivers.interfaces import Vector
from statemachine.control import RunControl
from statemachine.journal import Journal
from statemachine.runner import Event, Runner, Script
from statemachine.step import Outcome


@dataclass(frozen=True, eq=False)
class ReadyJob:
    """A job with its kind, up to the step after which it is to end, its surface, and the script that looks at it.
    `info` is for the journal: what a resumed run has to know."""

    job: Job
    kind: Kind
    nominal: NominalSurface
    script: Script
    info: dict[str, object]
    ground: tuple[Vector, Vector] | None = None

    @classmethod
    def read(
        cls, file: str | Path, config: CellConfig, until: str | None, script: Script, *, calibrates: bool = False
    ) -> Self:
        """From its file or by its name; `ConfigError` when it does not fit the cell or has no such step. With
        `calibrates` the cell may be calibrated first, with this job's part in the claw."""
        job, mesh = load_job(file)
        require_fit(job, config, mesh, calibrates=calibrates)
        kind = kind_of(job).until(until)
        kind.require_steps(script.after)
        ground = ground_below(job, mesh_box(mesh, job.surface.mesh_unit)) if job.unloads else None
        job, mesh = sought(job, mesh)
        nominal = nominal_of(job, mesh)
        info: dict[str, object] = dict(job_source(file))
        if job.at_stop is not None:
            info["stop"] = job.at_stop
        # A resumed run must end where this one was to end, and be looked at as this one was.
        if until is not None:
            info["until"] = until
        if not script.idle:
            info["scripted"] = True
        return cls(job, kind, nominal, script, info, ground=ground)


Observer = Callable[[Event], None]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended: `outcome` is placed (done, for a kind of job that places nothing), refused, misplaced, faulted
    or aborted; `report` is what report.json holds, `results` what each step made, by its name.

    One that a signal reached too late to end it keeps its outcome, and is `interrupted` all the same. `wall_s` are the
    seconds that it took on the wall, which the report of a run on the virtual clock does not hold.
    """

    outcome: str
    reason: str
    folder: Path
    report: Mapping[str, Any]
    results: Mapping[str, object] = field(default_factory=dict, repr=False)
    control: RunControl = field(default_factory=RunControl, repr=False, compare=False)
    wall_s: float = field(default=0.0, repr=False, compare=False)

    @property
    def interrupted(self) -> bool:
        """Whether a signal has asked the program to end since the run began."""
        return self.control.signal is not None

    @property
    def stopped_after_end(self) -> bool:
        """Whether somebody stopped the cell, or asked to end the run, after the outcome was decided."""
        return self.control.late

    @property
    def exit_code(self) -> int:
        """130 interrupted, else 0 placed or done, 1 otherwise."""
        return 130 if self.interrupted else 0 if self.outcome in ("placed", "done") else 1

    def __str__(self) -> str:
        return f"{self.outcome}: {self.reason}"

    def __repr__(self) -> str:
        return f"<RunOutcome {self.outcome}, run {self.folder.name}>"


@dataclass(frozen=True, eq=False)
class JobRun:
    """Everything that one run of a job needs; `perform` does it. `info` goes into the journal and the report.

    `run` is the handle by which it is held. `inline` observers see each event before the run goes on: those that cause
    faults or look at the truth. `earlier` is the sweep of a run that this one resumes, `held` how that one had gripped
    a part from its nest; `script` works between steps. `truth` asks a simulated world. `pace` says how fast arm and
    vehicle go, of what is planned. `parts_before` is what
    the parts before this one of its batch tell.
    """

    run: Run[object]
    config: CellConfig
    devices: Devices
    ready: ReadyJob
    calibration: CellCalibration
    info: Mapping[str, object]
    inline: tuple[Observer, ...] = ()
    earlier: StoredSweep | None = None
    held: HeldPart | None = None
    truth: Callable[[], dict[str, object]] | None = None
    pace: Pace = field(default_factory=Pace)
    parts_before: PartsBefore = field(default_factory=PartsBefore)

    def perform(self, root: Path, whereabouts: Whereabouts) -> RunOutcome:
        """Run the job in a new folder below `root`. Raises `CellError` only when no run can be recorded there."""
        with new_folder(root) as folder:
            write_json(folder / "configuration.json", self.config.model_dump(mode="json"))
            write_json(folder / "job.json", self.ready.job.model_dump(mode="json"))
            save_calibration(self.calibration, folder / "calibration.json")
            journal = Journal(folder, folder.name, self._facts())
        self.run.folder = folder
        try:
            with run_log(folder), recorded(folder, self.run, self.config, self.devices, self.calibration) as record:
                return self._recorded(folder, journal, whereabouts, record)
        finally:
            journal.close()

    def _recorded(
        self, folder: Path, journal: Journal, whereabouts: Whereabouts, record: Recorder | None
    ) -> RunOutcome:
        started = time.time()
        begun = self.devices.clock.now()
        open_before = self.devices.gate.is_open
        witness = None if self.truth is None else TruthRecorder(self.truth)
        observers = (*self.inline, *(() if witness is None else (witness,)), self.run.notify)
        listener = None if record is None else record.frame
        with FrameStore(folder / "frames", listener, kept=self.config.cell.frames) as frames:
            self.run.frames = frames
            workplace = self._workplace(folder, whereabouts, frames)
            result = self._runner(workplace, journal, each_of(observers)).run()
        save_perception(folder, result)
        if open_before and result.outcome in (Outcome.PLACED, Outcome.DONE):
            self._open_again()
        if result.outcome is not Outcome.PLACED:
            result = replace(result, reason=workplace.part.explain(result.reason))
        elif self.ready.job.part is not None:
            result = replace(result, reason=seen_words(result))
        finished = FinishedJob(
            folder, self.config, workplace.job, nominal=self.ready.nominal, repeatability=workplace.repeatability,
            result=result, info=self._facts_after(begun, workplace), started=started, witness=witness, frames=frames,
        )  # fmt: skip
        report = finished.report()
        return RunOutcome(
            report["outcome"], report["reason"], folder, report=report, results=result.results,
            control=self.run.control, wall_s=time.time() - started,
        )  # fmt: skip

    def _workplace(self, folder: Path, whereabouts: Whereabouts, frames: FrameStore) -> Workplace:
        job, kind = self.ready.job, self.ready.kind
        state = PartState.first(job) if self.held is None else PartState.HELD
        return Workplace(
            self.config, job, self.ready.nominal, calibration=self.calibration, devices=self.devices, frames=frames,
            folder=folder, whereabouts=whereabouts, earlier=self.earlier, held=self.held,
            needs_part=kind.places and state is PartState.HELD, looks_after=verify.STEP.name in kind.names,
            looks_again=place.STEP in kind.steps or pick.STEP in kind.steps, shares_look=kind.sees_place,
            sweeping=self._sweeping, registered=self._registered, pace=self.pace, ground=self.ready.ground,
            parts_before=self.parts_before, part=PartProgress(state),
        )  # fmt: skip

    def _runner(self, workplace: Workplace, journal: Journal, observer: Observer) -> Runner:
        return Runner(
            sequence=self.ready.kind.sequence(), steps=self.ready.kind.work(workplace),
            policy=self.ready.kind.policy(simulated_person=self.config.cell.confirm == "simulated"), journal=journal,
            clock=self.devices.clock, classify=partial(classify, following=self.devices.following),
            safe_stop=lambda reason: stop_cell(self.devices), observer=observer, recover=partial(clear, self.devices),
            health=lambda: require_healthy(self.devices), control=self.run.control,
            script=self._in_the_gate(self.ready.script),
        )  # fmt: skip

    def _open_again(self) -> None:
        """The stop at the end of a good run keeps nobody from going on. One from before the run still does, and one
        that a person asked for meanwhile."""
        stops = self.devices.gate.stops
        if not self.run.control.late:
            self.devices.gate.clear(stops)

    def _facts_after(self, begun: float, workplace: Workplace) -> dict[str, object]:
        """What the report says of the run besides its result; `begun` is a time of the cell's clock."""
        cell_s = round(self.devices.clock.now() - begun, 3)
        facts: dict[str, object] = {"cell_s": cell_s, **self._facts(), "part": workplace.part.state.value}
        injectors = (each for each in self.inline if isinstance(each, Injector))
        if missed := {name: why for each in injectors for name, why in each.missed.items()}:
            facts["not_injected"] = [{"fault": name, "why": why} for name, why in missed.items()]
        if self.devices.following is not None:
            facts["following"] = self._following(self.devices.following)
        return facts

    def _sweeping(self, collector: SweepCollector, base_from_surface: pin.SE3) -> None:
        self.run.registered = None
        self.run.sweeping = Sweeping(collector, base_from_surface, self.ready.nominal)

    def _registered(self, base_from_surface: pin.SE3) -> None:
        self.run.registered = base_from_surface

    def _following(self, following: DeviceFollowing) -> dict[str, Any]:
        try:
            return following.figures()
        except CellError as error:
            return {"missing": str(error)}

    def _facts(self) -> dict[str, object]:
        return {
            "kind": "job", "pid": os.getpid(), "cell": self.config.cell.name, "job": self.ready.job.job.name,
            "job_kind": self.ready.job.job.kind, **self.info, "speed": self.config.cell.time_scale,
            "configuration_hash": self.config.calibration_hash(), "calibration_hash": self.calibration.hash(),
            "calibration_date": self.calibration.date,
            **({"calibration_edits": list(self.calibration.edits)} if self.calibration.edits else {}),
        }  # fmt: skip

    def _in_the_gate(self, script: Script) -> Script:
        """The script, whose calls enter the gate as work of this run: what they begin ends with the run, not before."""
        gate, token = self.devices.gate, self.run.control.token

        def entered(call: Callable[..., Any]) -> Callable[..., Any]:
            def work(*arguments: object) -> Any:
                with gate.entered(token):
                    return call(*arguments)

            return work

        after = {name: entered(look) for name, look in script.after.items()}
        return replace(script, after=after, on_refusal=script.on_refusal and entered(script.on_refusal))


def each_of(observers: tuple[Observer, ...]) -> Observer:
    """One observer that tells all; one that fails is told nothing more and keeps no other from listening."""
    listening = list(observers)

    def notify(event: Event) -> None:
        for observer in list(listening):
            try:
                observer(event)
            except Exception as error:
                listening.remove(observer)
                log.warning("an observer of the run failed and is told nothing more: %s", error)

    return notify


@dataclass(frozen=True, eq=False)
class JobWork:
    """A job, read as `ready` from `file`, for a run of this cell; `info` goes into the journal and the report.

    `stored` is its calibration, or why there is none: then it is calibrated first. `before` is the run that this one
    resumes, `at_start` somebody's word that the vehicle stands at the job's start pose, for this run alone.
    `parts_before` is what the parts before this one of its batch tell.
    """

    cell: OpenCell
    file: str | Path
    ready: ReadyJob
    info: Mapping[str, object]
    stored: CellCalibration | CalibrationStale
    before: UnfinishedRun | None
    inline: tuple[Observer, ...]
    at_start: bool
    parts_before: PartsBefore

    def perform(self, run: Run[RunOutcome]) -> RunOutcome:
        """Do it; raises what `JobRun.perform` raises. Ended as any run where the calibration before it ends it."""
        cell, ready = self.cell, self.ready

        def note(text: str) -> None:
            run.notify(Event("note", None, {"text": text}))

        if (simulated := cell.simulated) is not None and not is_whole(simulated):
            for sentence in beware(simulated.simulated, DEVICES):
                note(sentence)
            if (following := cell.devices.following) is not None:
                note(f"readings reach the simulated world after: {following_words(following.figures())}")
        if self.at_start:
            cell.whereabouts.say_at_start()
        calibration = self.stored
        if isinstance(calibration, CalibrationStale):
            why = str(calibration).partition("; run `cell calibrate`")[0]
            none = "this simulated cell has no calibration yet"
            note(f"{none if 'holds no calibration of these devices' in why else why}: calibrating first")
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
            run, cell.config, cell.devices, ready=ready, calibration=calibration, info=self.info, inline=self.inline,
            earlier=earlier, held=None if self.before is None else self.before.held, truth=cell.truth, pace=cell.pace,
            parts_before=self.parts_before,
        )  # fmt: skip
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
        run.notify(Event("run_ended", None, {"outcome": outcome, "reason": reason}))
        report = {**read_report(run.folder), "outcome": outcome, "reason": reason}
        return RunOutcome(outcome, reason, run.folder, report, control=run.control, wall_s=wall_s)
