"""The cell as a program sees it: open it, run jobs, calibrate, stop, close.

with Cell.open("cell.toml", sim="all", seed=7) as cell:
    result = cell.run(job="pot")
"""

import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Self, TypeVar

from cell.base.compiled import load
from cell.base.lateness import LATENESS
from cell.check.fit import read_fitting
from cell.config.calibrations.store import CalibrationEdited, CellCalibration
from cell.config.cell_config import DEVICES, CellConfig, Confirm
from cell.config.job import Job, item_names, load_job
from cell.devices.devices import Devices, stop_cell
from cell.devices.simulated.mixed import Sim
from cell.devices.simulated.process import Injector, Simulation, is_whole
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import Mover
from cell.procedures.calibrate.verification import Verification
from cell.procedures.drive.way import Whereabouts
from cell.procedures.steps.kinds import kind_of
from cell.procedures.steps.workplace import PartsBefore
from cell.run import batch as batches
from cell.run import calibration as sessions
from cell.run.batch import BatchOutcome
from cell.run.calibration import recorded_maintenance
from cell.run.folder import find_run
from cell.run.job_run import JobWork, Observer, ReadyJob, RunOutcome
from cell.run.jogging import arm_is_ready, begin_program
from cell.run.recorded_work import WorkContext
from cell.run.resumption import UnfinishedRun
from cell.run.runs import Run, Runs
from cell.run.session.session import OpenCell, SessionRequest
from drivers.errors import CalibrationStale, ConfigError, DeviceFault
from statemachine.runner import NO_SCRIPT, Event, Script
from statemachine.watch import EndSignals, SignalInterrupt, SignalWatch

HOMED = {"rail": ("rail",), "arm": ("arm", "vehicle")}
"""What `home` brings home by itself, and the devices that it needs: the arm moves only beside a braked vehicle."""

Made = TypeVar("Made")
_OnStored = Callable[[OpenCell, Run[object], CellCalibration, Job], Made]

log = logging.getLogger(__name__)


class Cell:
    """One cell, held by this process until `close()`. One run at a time; `stop()` and `close()` end it.

    Its methods are called by one thread, `stop()`, `close()` and those of a run's handle by any. While it is open
    SIGTERM and SIGHUP end the program as Ctrl-C does: through the safe stop.
    """

    def __init__(self, opened: OpenCell) -> None:
        self._open_cell = opened
        self.config: CellConfig = opened.config
        self.folder: Path = opened.folder
        self.devices: Devices = opened.devices
        self.simulated: Simulation | None = opened.simulated
        if self.simulated is not None and "vehicle" in self.simulated.simulated and "vehicle" in self.devices:
            # The world that this process has just started puts the vehicle there.
            self.whereabouts.say_at_start()
        self._runs = Runs(self.config.cell.name)
        self._signals = EndSignals()
        self._fed = self.simulated is None or self.simulated.facts.get("clock") != "virtual"
        if self._fed:
            LATENESS.begin(self.config.cell.time_scale)

    @classmethod
    def open(
        cls, config: str | Path | None = None, *, sim: Sim = None, seed: int = 1, level: str = "nominal",
        speed: float | None = None, job: str | Path = "pot", confirm: Confirm | None = None,
        only: Collection[str] = tuple(DEVICES), clock: str = "wall", truth: str | Path | None = None,
    ) -> Self:  # fmt: skip
        """Connect to the cell's devices and hold them; or start a simulated cell and hold that.

        Args:
            config: The cell's configuration. Without it, `cell.toml` of the present folder; where there is none, only
                a simulated cell is opened, as it ships. Runs and calibrations go beside the file, else to the folder.
            sim: "all", "none", or the devices that are simulated, as a list or with commas; a simulated world then
                follows what the real ones measure of themselves. Without it, `cell.sim` of the configuration.
            seed: Which simulated world, 0 to 999999.
            level: How far that world deviates from the drawing: "ideal", "nominal", "harsh", "workshop" or "outdoor".
            speed: How many times faster than the wall a simulated cell over wires runs, 0.1 to 20. Without it 3, or as
                much as a slower computer keeps, 1 at least.
            job: Whose station, surface and part a simulated cell has at first.
            confirm: Instead of `cell.confirm`: who answers for a person; "simulated" in a simulated cell only.
            only: The devices to connect, and what they hang on. Others may be off: asked, they are not connected.
            clock: "wall": over the devices' real protocols. "virtual": models in this process, without wires or
                waiting; the same seed and stored calibration give the same course, to the byte.
            truth: Another configuration, by which the simulated cell is built: one that is not as it was written down.

        Raises:
            ConfigError: What is asked for cannot be, by physics or by the files; nothing was started.
            InterlockError: Another process holds the cell.
            NotConnectedError, DeviceFault: This device does not answer.
        """
        with EndSignals(), ExitStack() as undo:
            load()
            request = SessionRequest(
                config=config, sim=sim, seed=seed, level=level, speed=speed, job=job, confirm=confirm, only=only,
                clock=clock, truth=truth,
            )  # fmt: skip
            cell = cls(request.open(undo))
            undo.pop_all()
        # After the context above has given the handlers back: of two that are nested the outer one would win.
        cell._signals.__enter__()
        return cell

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        try:
            self.close()
        except SignalInterrupt:
            # The first reason to end is the one that is told.
            if error is None:
                raise

    @property
    def whereabouts(self) -> Whereabouts:
        """What is known of where the vehicle stands."""
        return self._open_cell.whereabouts

    @property
    def pace(self) -> float:
        """The share of their planned speed at which arm and vehicle move in a run, 0.25 to 1 (see `Pace`).

        Set from any thread, it holds from the next motion on, in this run and all later ones. `ConfigError` for
        anything else.
        """
        return self._open_cell.pace.share

    @pace.setter
    def pace(self, share: float) -> None:
        if share == self.pace:
            return
        self._open_cell.pace.share = share
        log.info("arm and vehicle move at %.0f %% of their planned speed from the next motion on", 100 * share)

    @property
    def runs_folder(self) -> Path:
        """Where run folders go."""
        return self._open_cell.runs_folder

    @property
    def calibrations_folder(self) -> Path:
        """Where calibrations are stored."""
        return self._open_cell.calibrations_folder

    def mover(self, job: Job | None, hold: Callable[[], None] = lambda: None) -> Mover:
        """Planned moves of the arm, for jogging and calibration; with a job, its part is in the claw.

        `hold` is called before each free motion: a paused run waits in it.
        """
        return self._open_cell.mover(job, hold)

    @property
    def current(self) -> Run[object] | None:
        """The run that is going on, or None."""
        return self._runs.current

    def stop(self) -> None:
        """End the run that is going on, and bring the whole cell to rest now, whatever it does.

        Laser off, vehicle stopped and braked, rail and arm stopped. Callable from any thread; the run then ends as
        aborted. One that had just come to a good end keeps its outcome and says `stopped_after_end`; the next job is
        then not begun, once, and raises `Aborted`, so that a loop over jobs ends as well. Direct commands are held
        until a person begins a run or calls `clear_stop`.
        Raises `DeviceFault` that lists what could not be confirmed; everything was tried all the same.
        """
        self._runs.stop()
        stop_cell(self.devices)

    def clear_stop(self, by: str) -> None:
        """Let direct commands pass again after a stop. A new run needs no such word, and says it for nobody else.

        Args:
            by: The person who has seen that the cell may move again.

        Raises:
            ConfigError: Nobody is named.
        """
        if not by.strip():
            raise ConfigError("clear_stop needs the name of the person who has looked at the cell")
        log.warning("the stop was cleared by %s", by)
        self.devices.gate.clear()

    @contextmanager
    def maintenance(self, reason: str, lift: Sequence[str]) -> Iterator[None]:
        """Inside this context the interlocks named in `lift` do not hold (docs/reference/interlocks.md lists them).

        On a person's responsibility, and recorded: in the log of the run that is going on, else as a run of its own;
        runs that are begun meanwhile say so in their report.

        Args:
            reason: Why, for the record.
            lift: Names of interlocks.

        Raises:
            ConfigError: No reason, or a name that is none or that nobody can lift.
        """
        if not reason.strip() or not lift:
            raise ConfigError("maintenance needs a reason, and the names of the interlocks to lift")
        with ExitStack() as over:
            over.enter_context(self.devices.interlocks.lifted(lift))
            text = f"maintenance ({reason}): lifted {', '.join(lift)}"
            if (run := self.current) is not None:
                run.notify(Event("note", None, {"text": text}))
            else:
                over.enter_context(recorded_maintenance(self.runs_folder, self._open_cell.facts, reason, lift))
            log.warning("%s", text)
            try:
                yield
            finally:
                log.warning("maintenance (%s) is over: %s hold again", reason, ", ".join(lift))

    def close(self) -> None:
        """End the run that is going on, stop and disconnect everything, let go of the cell.

        Idempotent, callable from any thread, shielded from interrupts: one that comes meanwhile is raised at the end,
        as `SignalInterrupt`.
        """
        with SignalWatch() as signals:
            if not self._runs.close():
                return
            if self._fed:
                LATENESS.end()
            try:
                self._runs.end()
                problems = self.devices.stop() + self.devices.close()
            finally:
                self._open_cell.lock.__exit__(None, None, None)
                if self.simulated is not None:
                    self.simulated.close()
        self._signals.__exit__(None, None, None)
        for problem in problems:
            log.warning("closing the cell: %s", problem)
        if signals.number is not None:
            raise SignalInterrupt(signals.number)

    @property
    def stops(self) -> int:
        """How often it was stopped so far; work that is prepared first hands this to `begin` or `perform`."""
        return self._runs.stops

    def begin(
        self, kind: str, work: Callable[[Run[Made]], Made], observer: Observer | None = None, stops: int | None = None
    ) -> Run[Made]:
        """Begin a run of a kind; `InterlockError` while another one is going on or the cell is closed.

        `stops` is the count of stops when it was asked for: `Aborted` when another one came since.
        """
        return self._runs.begin(kind, work, observer, stops)

    def perform(
        self, kind: str, work: Callable[[WorkContext], Made], observer: Observer | None = None,
        info: Mapping[str, object] | None = None, stops: int | None = None,
    ) -> Made:  # fmt: skip
        """Do work outside a job, such as a jog, as a recorded run, and wait for its end. `stops` as in `begin`."""
        return self.begin(kind, lambda run: self._open_cell.recorded(run, kind, work, info), observer, stops).result()

    def run(
        self, job: str | Path = "pot", observer: Observer | None = None, inject: Sequence[str] = (), *,
        at_start: bool = False, until: str | None = None, script: Script = NO_SCRIPT,
    ) -> RunOutcome:  # fmt: skip
        """`start` a job, with the same arguments, and wait for its end.

        Returns:
            How the run ended, with its report. However it ends, nothing is raised.

        Raises:
            CellError: What is wrong before anything moves, as `start` does.
        """
        return self.start(job, observer, inject, at_start=at_start, until=until, script=script).result()

    def start(
        self, job: str | Path = "pot", observer: Observer | None = None, inject: Sequence[str] = (), *,
        at_start: bool = False, until: str | None = None, script: Script = NO_SCRIPT,
    ) -> Run[RunOutcome]:  # fmt: skip
        """Begin a job. A simulated cell is set up for it and its claw filled, and calibrated first if need be.

        Args:
            job: A job's file, or a name: NAME.toml of the present folder, else the job that ships.
            observer: Called with each event, in the run's own thread.
            inject: Faults of a simulated cell and when, such as "arm.protective_stop@laser_sweep:40%".
            at_start: Somebody's word that the vehicle stands at the job's start pose. Without it a run drives only when
                the vehicle sees the board, or when this `Cell` has seen it before.
            until: The step after which the run ends, done; `RunOutcome.results` has what the steps made.
            script: Looks at results between the steps, and decides about refusals.

        Returns:
            The run: `pause`, `go_on`, `confirm`, `abort`, `events`, `result`. It writes its own folder.

        Raises:
            ConfigError: The job, or how it was asked for, is wrong.
            CalibrationStale: A cell with a real device has no calibration that holds.
            InterlockError: Another run is going on.
        """
        return self._start(job, observer, {}, None, inject=inject, at_start=at_start, until=until, script=script)

    def run_batch(
        self, job: str | Path = "pot", count: int = 1, observer: Observer | None = None, inject: Sequence[str] = (), *,
        at_start: bool = False,
    ) -> BatchOutcome:  # fmt: skip
        """`run` a job for `count` parts, 1 to 10000, and wait for the end of the batch; arguments as in `start`.

        A simulated cell's claw is filled again for each part. At a real cell a person is asked for each further part:
        the `observer` sees `confirm_needed`, and `current.confirm` or `cell confirm` answers. It is told each part's
        end, as a note. `at_start` is said for the first part.

        Raises:
            CellError: What keeps the first part from being begun.
        """
        names = item_names(job)
        read_fitting(job, self.config, calibrates=is_whole(self.simulated))
        jobs = [load_job(name)[0] for name in names]
        # A stop between two parts counts as one in a part: no other is begun.
        stops = self.stops
        for each in jobs if inject else ():
            Injector.scheduled(inject, kind_of(each).names, self.simulated)
        return batches.perform(
            self._open_cell, jobs, count,
            run=lambda number, parts_before: self._start(
                names[(number - 1) % len(names)], observer, {}, None, inject=inject,
                at_start=at_start and number == 1, parts_before=parts_before, stops=stops,
            ).result(),
            between=lambda work: self.perform("loading", work, observer, stops=stops), observer=observer,
        )  # fmt: skip

    def resume(
        self, run: str | Path | None = None, observer: Observer | None = None, *, at_start: bool = False,
        script: Script = NO_SCRIPT,
    ) -> RunOutcome:  # fmt: skip
        """Do the job of a run that was aborted, faulted or cut short, as a new run, and wait for its end.

        If the vehicle sees the board, it stays where it is. A finished sweep is used again if the board has not
        moved. If that run had `until`, this one stops after the same step.

        Args:
            run: The run's name, the end of it, or its folder; without it the newest.
            observer: As in `start`.
            at_start: As in `start`.
            script: As in `start`; a run that a script looked at is resumed with one only.

        Raises:
            ConfigError: There is nothing to resume.
        """
        folder = find_run(self.runs_folder, None if run is None else str(run), "job")
        before = UnfinishedRun.find(folder, scripted=not script.idle)
        info: dict[str, object] = {"resumed_from": before.folder.name}
        self.pace = min(self.pace, before.info.get("pace", 1.0))
        until = before.info.get("until")
        return self._start(before.job, observer, info, before, at_start=at_start, until=until, script=script).result()

    def _start(
        self, job: str | Path, observer: Observer | None, info: dict[str, object], before: UnfinishedRun | None,
        inject: Sequence[str] = (), *, at_start: bool, until: str | None = None, script: Script = NO_SCRIPT,
        parts_before: PartsBefore | None = None, stops: int | None = None,
    ) -> Run[RunOutcome]:  # fmt: skip
        inline: tuple[Observer, ...] = ()
        if inject:
            injector = Injector.scheduled(inject, kind_of(load_job(job)[0]).names, self.simulated)
            info["injected"] = [str(injection) for injection in injector.injections]
            inline = (injector,)
        if len(items := item_names(job)) > 1:
            raise ConfigError(f"job {job} has {len(items)} items: name one, such as {items[0]}, or run all as a batch")
        self._runs.require_free()
        self._runs.require_no_late_stop()
        stops = self.stops if stops is None else stops
        ready = ReadyJob.read(job, self.config, until, script, calibrates=is_whole(self.simulated))
        if before is not None and is_whole(self.simulated) and not self.devices.claw.holding:
            # The part of a simulated world that has ended lies in its nest again.
            before = replace(before, held=None)
        if before is not None and before.held is not None:
            info["held"] = before.held.as_dict()
        elif self.simulated is not None:
            from cell.devices.simulated.described import Described

            self.simulated.make_ready(Described.of(job))
        try:
            stored: CellCalibration | CalibrationStale = self.calibration()
        except CalibrationStale as error:
            # A simulated cell is calibrated by itself, but never over what a person has edited.
            if isinstance(error, CalibrationEdited) or not is_whole(self.simulated):
                raise
            stored = error
        info |= {**self._open_cell.world, **ready.info}
        work = JobWork(
            self._open_cell, job, ready, info, stored=stored, before=before, inline=inline, at_start=at_start,
            parts_before=parts_before or PartsBefore(),
        )  # fmt: skip
        return self.begin("job", work.perform, observer, stops)

    def calibration(self) -> CellCalibration:
        """The stored calibration of this very cell as configured; see `find_calibration`, also for what it raises."""
        return sessions.stored(self._open_cell)

    def calibrate(self, observer: Observer | None = None, job: str | Path = "pot") -> CellCalibration:
        """Move through the calibration poses over the deck boards, solve, and store the result and what it came from.

        Args:
            observer: As in `start`.
            job: Whose part may be in the claw: it touches nothing on the way.

        Raises:
            RefusedError: A measurement is not good enough; what was stored before stays.
        """
        stops = self.stops
        load_job(job)
        return self.begin(
            "calibration", lambda run: sessions.calibrate(self._open_cell, run, job), observer, stops
        ).result()

    def verify(self, observer: Observer | None = None, job: str | Path = "pot") -> Verification:
        """Look at the deck boards again and say how good the stored calibration is today.

        A turn of the laser that the board confirms is kept with the calibration, for jobs.

        Args:
            observer: As in `start`.
            job: Whose part may be in the claw, and for whose place the error is computed.

        Raises:
            CalibrationStale: There is no calibration, or one without a reference.
            RefusedError: A board is not seen.
        """
        return self._on_stored("verification", sessions.verify, observer, job)

    def time_stamps(self, observer: Observer | None = None, job: str | Path = "pot") -> CellCalibration:
        """Measure how late the scan camera's time stamps come, by sweeps to and fro over the fine board.

        Args:
            observer: As in `start`.
            job: Whose part may be in the claw.

        Returns:
            The stored calibration with the delay, by which every later sweep of the rail corrects its times.

        Raises:
            CalibrationStale: There is no calibration.
            RefusedError: A rolling shutter, stamps that no correction mends, or sweeps that do not tell.
        """
        return self._on_stored("timing", sessions.time_stamps, observer, job)

    def _on_stored(self, kind: str, work: _OnStored[Made], observer: Observer | None, job: str | Path) -> Made:
        """Work on the stored calibration, with the part of `job` in the claw, as a run; wait for its end."""
        stops = self.stops
        loaded, _ = load_job(job)
        calibration = self.calibration()
        return self.begin(kind, lambda run: work(self._open_cell, run, calibration, loaded), observer, stops).result()

    def recover(self, by: str, observer: Observer | None = None) -> None:
        """Unlock the arm's protective stop, connect a lost link, clear the vehicle's fault. Nothing moves.

        Args:
            by: The person who has looked at the cell.
            observer: As in `start`.

        Raises:
            ConfigError: Nobody is named.
            DeviceFault: Only the pendant or the emergency stop's button clears it.
        """
        if not by.strip():
            raise ConfigError("recover needs the name of the person who has looked at the cell")

        def work(context: WorkContext) -> None:
            arm, vehicle = self.devices.arm, self.devices.vehicle
            if not arm_is_ready(arm):
                arm.recover(confirmed=True)
            try:
                vehicle.check()
            except DeviceFault:
                vehicle.recover()

        self.perform("recovery", work, observer, {"by": by})

    def home(self, device: str | None = None, observer: Observer | None = None) -> None:
        """Home the rail and fold the arm above the deck.

        Args:
            device: "rail" or "arm": that one only.
            observer: As in `start`.

        Raises:
            ConfigError: Another device is named.
            InterlockError: Another run is going on, or the arm must not move now.
        """
        stops = self.stops
        if device not in (None, *HOMED):
            raise ConfigError(f'"{device}" has no home; {" and ".join(HOMED)} have')

        def work(context: WorkContext) -> None:
            if device != "arm":
                self.devices.rail.home().wait(60.0)
            if device != "rail":
                self.devices.vehicle.recover()
                begin_program(self.devices.arm)
                self.mover(None, context.safe_point).to_joints(HOME)

        self.perform("homing", work, observer, stops=stops)
