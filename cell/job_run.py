"""One job as a recorded run: its folder and journal, what watches the cell meanwhile, what an error means for it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.assembly import Devices
from cell.config import CellConfig
from cell.frames import FrameStore
from cell.guard import stop_not_confirmed
from cell.inversion import NominalSurface
from cell.job import Job
from cell.report.report import make_report
from cell.report.truth import Witness
from cell.runs import new_run, write_json
from cell.steps.approach import Odometry
from cell.steps.stored_sweep import StoredSweep
from cell.stored_calibration import CellCalibration, save_calibration
from cell.work import JobWork
from drivers.errors import (
    Aborted,
    CalibrationStale,
    CellError,
    ConfigError,
    DeadlineError,
    DeviceError,
    DeviceFault,
    RefusedError,
)
from drivers.interfaces import ArmSafety
from statemachine.journal import Journal, JournalError
from statemachine.policy import Failure, Outcome, Policy
from statemachine.runner import Event, Runner
from statemachine.sequence import Sequence
from statemachine.watch import SignalWatch

Observer = Callable[[Event], None]


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


@dataclass(frozen=True, eq=False)
class JobRun:
    """Everything that one run of a job needs; `perform` does it. `info` goes into the journal and the report.

    `earlier` is the sweep of a run that this one resumes.
    """

    config: CellConfig
    devices: Devices
    job: Job
    nominal: NominalSurface
    calibration: CellCalibration
    info: Mapping[str, Any]
    observer: Observer | None = None
    earlier: StoredSweep | None = None

    def perform(self, root: Path, odometry: Odometry | None) -> tuple[RunOutcome, Odometry | None]:
        """Run the job in a new folder below `root`. Raises `CellError` only when no run can be recorded there.

        `odometry` is where earlier runs left the vehicle; where this one leaves it is returned with the outcome.
        """
        with SignalWatch() as signals:
            try:
                folder = new_run(root)
                self._keep_inputs(folder)
                journal = Journal(folder, folder.name, self._facts())
            except (OSError, JournalError) as error:
                raise CellError(f"no run can be recorded in {root}: {error}") from error
            try:
                return self._recorded(folder, journal, odometry, signals)
            finally:
                journal.close()

    def _recorded(
        self, folder: Path, journal: Journal, odometry: Odometry | None, signals: SignalWatch
    ) -> tuple[RunOutcome, Odometry | None]:
        started = time.time()
        witness = Witness(self.config.cell.truth) if self.config.cell.truth else None
        with FrameStore(folder / "frames") as frames:
            work = JobWork(
                self.config,
                self.job,
                self.nominal,
                self.calibration,
                self.devices,
                frames,
                folder,
                odometry,
                self.earlier,
            )
            runner = Runner(
                Sequence(), work.steps(), Policy(), journal, self.devices.clock, classify,
                lambda reason: stop_cell(self.devices), both(self.observer, witness), self._recover, self._health,
            )  # fmt: skip
            if signals.reason is not None:
                runner.abort(signals.reason)
            result = runner.run()
        report = make_report(
            folder, self.config, self.job, self.nominal, work.repeatability, result, self._facts(), started, witness,
            frames.failure,
        )  # fmt: skip
        interrupted = result.signal is not None or signals.reason is not None
        return RunOutcome(report["outcome"], report["reason"], folder, report, interrupted), work.odometry

    def _facts(self) -> dict[str, Any]:
        return {
            "cell": self.config.cell.name,
            "job": self.job.job.name,
            **self.info,
            "speed": self.config.cell.time_scale,
            "configuration_hash": self.config.calibration_hash(),
            "calibration_hash": self.calibration.hash(),
            "calibration_date": self.calibration.date,
        }

    def _keep_inputs(self, folder: Path) -> None:
        write_json(folder / "configuration.json", self.config.model_dump(mode="json"))
        write_json(folder / "job.json", self.job.model_dump(mode="json"))
        save_calibration(self.calibration, folder / "calibration.json")

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


def stop_cell(devices: Devices) -> None:
    """Bring every device to rest; raises `DeviceFault` that lists what could not be confirmed."""
    if problems := devices.stop():
        raise stop_not_confirmed("; ".join(problems))


def both(first: Observer | None, second: Observer | None) -> Observer:
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
