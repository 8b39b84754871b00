"""The cell as a program sees it: open it, run jobs, calibrate, stop, close.

with Cell.open("cell.toml", sim="all", seed=7) as cell:
    result = cell.run(job="pot")
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from cell.assembly import Devices, connect
from cell.config import CellConfig, load_config
from cell.frames import FrameStore
from cell.inversion import NominalSurface
from cell.job import Job, load_job, require_fit
from cell.report.report import make_report
from cell.report.truth import Witness
from cell.runs import CellLock, new_run, write_json
from cell.simulation import SimulatedCell, with_endpoints
from cell.steps.approach import Odometry
from cell.steps.collect import collect_scan, collect_target
from cell.steps.moves import HOME, Mover
from cell.stored_calibration import CellCalibration, find_calibration, save_calibration
from cell.work import JobWork
from drivers.errors import (
    Aborted,
    CalibrationStale,
    CellError,
    ConfigError,
    DeadlineError,
    DeviceError,
    DeviceFault,
    Interrupted,
    RefusedError,
)
from drivers.interfaces import ArmSafety
from statemachine.journal import Journal, JournalError
from statemachine.policy import Failure, Outcome, Policy
from statemachine.runner import Event, Runner
from statemachine.sequence import Sequence
from statemachine.watch import Call, SignalWatch

SIM_SPEED = 3.0
"""How many times faster than the wall a simulated cell runs unless told otherwise."""

Observer = Callable[[Event], None]
Made = TypeVar("Made")


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended: `outcome` is placed, refused, faulted or aborted; `report` is what report.json holds."""

    outcome: str
    reason: str
    folder: Path
    report: Mapping[str, Any]
    interrupted: bool = False

    @property
    def exit_code(self) -> int:
        """0 placed, 130 interrupted, 1 otherwise."""
        return 0 if self.outcome == "placed" else 130 if self.interrupted else 1


class Cell:
    """One cell, held by this process until `close()`. Its methods are called by one thread; `stop()` by any."""

    def __init__(
        self, config: CellConfig, folder: Path, lock: CellLock, devices: Devices, simulated: SimulatedCell | None
    ) -> None:
        self.config = config
        self.folder = folder
        self.devices = devices
        self.simulated = simulated
        self._lock = lock
        self._odometry: Odometry | None = None
        self._closed = False

    @classmethod
    def open(
        cls,
        config: str | Path | None = None,
        *,
        sim: str | None = None,
        seed: int = 1,
        level: str = "nominal",
        speed: float = SIM_SPEED,
        surface: str = "pot",
    ) -> Cell:
        """Connect to every device of the cell, or of a simulated one that is started for it with `sim="all"`.

        Without `config` the configuration that ships is used, and runs and calibrations go below the present folder.
        Raises `ConfigError` before anything is started, `InterlockError` when another process holds the cell,
        `NotConnectedError` or `DeviceFault` that names the device that does not answer.
        """
        if sim not in (None, "all"):
            raise ConfigError(
                f'sim="{sim}" is not offered: "all" simulates the whole cell, leave it out for real devices'
            )
        path = None if config is None else Path(config)
        loaded = load_config(path)
        folder = Path.cwd() if path is None else path.resolve().parent
        simulated = None
        if sim == "all":
            simulated = SimulatedCell(seed=seed, level=level, speed=speed, surface=surface)
            loaded = with_endpoints(loaded, simulated.endpoints)
        try:
            lock = CellLock(loaded)
            lock.__enter__()
            try:
                return cls(loaded, folder, lock, connect(loaded), simulated)
            except BaseException:
                lock.__exit__(None, None, None)
                raise
        except BaseException:
            if simulated is not None:
                simulated.close()
            raise

    def __enter__(self) -> Cell:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @property
    def runs_folder(self) -> Path:
        """Where run folders go."""
        return self.folder / self.config.cell.runs

    @property
    def calibrations_folder(self) -> Path:
        """Where calibrations are stored."""
        return self.folder / self.config.cell.calibrations

    def mover(self, job: Job | None) -> Mover:
        """Planned moves of the arm, for jogging and calibration; with a job, its part is in the claw."""
        return Mover(self.devices.arm, self.devices.clock, self.config, job)

    def stop(self) -> None:
        """Bring the whole cell to rest: laser off, vehicle stopped and braked, rail and arm stopped.

        Raises `DeviceFault` that lists what could not be confirmed; everything was tried all the same.
        """
        problems = self.devices.stop()
        if problems:
            raise DeviceFault(
                "cell",
                "safe_stop",
                "; ".join(problems),
                recoverable=False,
                hint="Look at the cell before going near it.",
            )

    def close(self) -> None:
        """Stop and disconnect everything and let go of the cell. Idempotent, and shielded from interrupts."""
        if self._closed:
            return
        self._closed = True
        with SignalWatch():
            try:
                problems = self.devices.stop() + self.devices.close()
            finally:
                self._lock.__exit__(None, None, None)
                if self.simulated is not None:
                    self.simulated.close()
        for problem in problems:
            print(f"closing the cell: {problem}", file=sys.stderr)

    # --- jobs ---

    def run(self, job: str | Path = "pot", observer: Observer | None = None) -> RunOutcome:
        """Run a job to its end and write its folder. Raises only for what is wrong before anything moves.

        A simulated cell that has no calibration is calibrated first; a real one is not: `CalibrationStale`.
        """
        loaded, mesh = load_job(job)
        require_fit(loaded, self.config)
        nominal = NominalSurface.load(mesh, unit=loaded.surface.mesh_unit)
        try:
            calibration = self.calibration()
        except CalibrationStale:
            if self.simulated is None:
                raise
            if observer is not None:
                observer(Event("note", None, {"text": "this simulated cell has no calibration yet: calibrating first"}))
            calibration = self.calibrate(observer, job)
        with SignalWatch() as signals:
            try:
                folder = new_run(self.runs_folder)
                self._keep_inputs(folder, loaded, calibration)
                journal = Journal(folder, folder.name, self._info(loaded, calibration))
            except (OSError, JournalError) as error:
                raise CellError(f"no run can be recorded in {self.runs_folder}: {error}") from error
            try:
                return self._run_recorded(folder, journal, loaded, nominal, calibration, observer, signals)
            finally:
                journal.close()

    def _run_recorded(
        self,
        folder: Path,
        journal: Journal,
        job: Job,
        nominal: NominalSurface,
        calibration: CellCalibration,
        observer: Observer | None,
        signals: SignalWatch,
    ) -> RunOutcome:
        started = time.time()
        info = self._info(job, calibration)
        witness = Witness(self.config.cell.truth) if self.config.cell.truth else None
        with FrameStore(folder / "frames") as frames:
            work = JobWork(self.config, job, nominal, calibration, self.devices, frames, folder, self._odometry)
            runner = Runner(
                Sequence(), work.steps(), Policy(), journal, self.devices.clock, classify,
                lambda reason: self.stop(), _both(observer, witness), self._recover, self._health,
            )  # fmt: skip
            if signals.reason is not None:
                runner.abort(signals.reason)
            result = runner.run()
            self._odometry = work.odometry
        report = make_report(
            folder, self.config, job, nominal, work.repeatability, result, info, started, witness, frames.failure
        )
        interrupted = result.signal is not None or signals.reason is not None
        return RunOutcome(report["outcome"], report["reason"], folder, report, interrupted)

    def _health(self) -> None:
        """Raise when a safety system has stopped the arm or the vehicle, whichever device is being waited for.

        A reading that is too old says nothing here: the next command to that device finds a silent link.
        """
        try:
            safety = self.devices.arm.state().safety
            if safety is not ArmSafety.NORMAL:
                raise DeviceFault(
                    "arm",
                    f"arm.{safety.name.lower()}",
                    f"the arm is in {safety.value}",
                    recoverable=safety is ArmSafety.PROTECTIVE_STOP,
                    hint="Look for the reason and clear the way.",
                )
            if self.devices.vehicle.state().emergency_stop:
                raise DeviceFault(
                    "vehicle",
                    "vehicle.emergency_stop",
                    "the vehicle's emergency stop is pressed",
                    recoverable=False,
                    hint="Release it when it is safe, then run the job again.",
                )
        except DeadlineError:
            return

    def _recover(self, error: BaseException) -> None:
        """Clear the fault of a device, as far as a program may; a camera or the rail only needs the step again."""
        if isinstance(error, DeviceError) and error.device in ("arm", "laser", "claw"):
            self.devices.arm.recover()
        elif isinstance(error, DeviceError) and error.device == "vehicle":
            self.devices.gate.enter()
            self.devices.vehicle.enable()
            self.devices.vehicle.brake()

    def _info(self, job: Job, calibration: CellCalibration) -> dict[str, Any]:
        endpoints = {} if self.simulated is None else self.simulated.endpoints
        return {
            "cell": self.config.cell.name,
            "job": job.job.name,
            "simulated": self.simulated is not None,
            "seed": endpoints.get("seed"),
            "level": endpoints.get("level"),
            "speed": self.config.cell.time_scale,
            "configuration_hash": self.config.calibration_hash(),
            "calibration_hash": calibration.hash(),
            "calibration_date": calibration.date,
        }

    def _keep_inputs(self, folder: Path, loaded: Job, calibration: CellCalibration) -> None:
        write_json(folder / "configuration.json", self.config.model_dump(mode="json"))
        write_json(folder / "job.json", loaded.model_dump(mode="json"))
        save_calibration(calibration, folder / "calibration.json")

    # --- calibration ---

    def calibration(self) -> CellCalibration:
        """The stored calibration of this very cell as configured; raises `CalibrationStale` that says what differs."""
        return find_calibration(
            self.calibrations_folder,
            self._identities(),
            self.config.calibration_hash(),
            self.config.calibration.max_age,
        )

    def _identities(self) -> dict[str, str]:
        return {
            name: device.identity().serial
            for name, device in (
                ("arm", self.devices.arm),
                ("rail", self.devices.rail),
                ("scan_camera", self.devices.scan_camera),
                ("target_camera", self.devices.target_camera),
            )
        }

    def calibrate(self, observer: Observer | None = None, job: str | Path = "pot") -> CellCalibration:
        """Move through the calibration poses over the deck boards, solve, and store the result.

        `job` names the part that may be in the claw, so that it does not touch anything on the way.
        """
        part_of, _ = load_job(job)

        def tell(fraction: float, text: str) -> None:
            if observer is not None:
                observer(Event("progress", "calibrate", {"fraction": fraction, "text": text}))

        def work(check: Callable[[], None]) -> CellCalibration:
            mover = self.mover(part_of)
            self.devices.vehicle.brake()
            scan = collect_scan(self.config, self.devices, mover, check, lambda f, t: tell(0.65 * f, t))
            target = collect_target(self.config, self.devices, mover, check, lambda f, t: tell(0.65 + 0.3 * f, t))
            tell(0.96, "solving")
            return CellCalibration.solve(scan, target, self._identities(), self.config)

        calibration = self.guarded("calibration", work)
        save_calibration(calibration, self.calibrations_folder / f"{calibration.name}.json")
        tell(1.0, "stored")
        return calibration

    def home(self) -> None:
        """Home the rail and fold the arm above the deck."""

        def work(check: Callable[[], None]) -> None:
            self.devices.rail.home().wait(60.0)
            self.mover(None).to_joints(HOME)

        self.guarded("homing", work)

    def guarded(self, what: str, work: Callable[[Callable[[], None]], Made]) -> Made:
        """Do `work` in a thread; on Ctrl-C or any error stop the cell first, then raise. For work outside a job.

        `work` is given a function that raises once the work is to end, to be called between motions.
        """
        made: list[Made] = []
        with SignalWatch() as signals:

            def check() -> None:
                if signals.reason is not None:
                    raise Aborted(f"{what} {signals.reason}")

            def begin() -> None:
                self.devices.gate.enter()
                check()
                made.append(work(check))

            call = Call(what, begin)
            while not call.done.wait(0.05) and signals.reason is None:
                pass
            if signals.reason is not None or call.error is not None:
                problems = self.devices.stop()
                call.done.wait(5.0)
                unconfirmed = f"; not confirmed: {'; '.join(problems)}" if problems else ""
                if signals.reason is not None:
                    raise Interrupted(f"{what} {signals.reason}; the cell was stopped{unconfirmed}")
                if problems:
                    raise DeviceFault(
                        "cell",
                        "safe_stop",
                        f"{what}: {call.error}{unconfirmed}",
                        recoverable=False,
                        hint="Look at the cell before going near it.",
                    ) from call.error
                assert call.error is not None
                raise call.error
        return made[0]


def _both(first: Observer | None, second: Observer | None) -> Observer:
    """One observer that tells two."""
    observers = [observer for observer in (first, second) if observer is not None]

    def tell(event: Event) -> None:
        for observer in list(observers):
            try:
                observer(event)
            except Exception as error:  # one who cannot listen any more must not keep the other from listening
                observers.remove(observer)
                print(f"an observer of the run failed and is told nothing more: {error}", file=sys.stderr)

    return tell


def classify(error: BaseException) -> Failure:
    """What a step's exception means for the run."""
    match error:
        case RefusedError() | CalibrationStale() | ConfigError():
            return Failure(Outcome.REFUSED, str(error), type(error).__name__)
        case Aborted():
            return Failure(Outcome.ABORTED, str(error), "aborted")
        case DeviceFault():
            return Failure(Outcome.FAULTED, str(error), error.code, error.recoverable)
        case CellError():
            return Failure(Outcome.FAULTED, str(error), type(error).__name__)
    return Failure(Outcome.FAULTED, f"unexpected {type(error).__name__}: {error}", "internal")
