"""The cell as a program sees it: open it, run jobs, calibrate, stop, close.

with Cell.open("cell.toml", sim="all", seed=7) as cell:
    result = cell.run(job="pot")
"""

from __future__ import annotations

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
from cell.job import Job, load_job
from cell.report.report import make_report
from cell.report.truth import Witness
from cell.runs import REPORT, CellLock, new_run, write_json
from cell.simulation import SimulatedCell, with_endpoints
from cell.steps.collect import collect_scan, collect_target
from cell.steps.moves import HOME, Mover
from cell.stored_calibration import CellCalibration, find_calibration, save_calibration
from cell.work import JobWork
from drivers.errors import Aborted, CalibrationStale, CellError, ConfigError, DeviceError, DeviceFault, RefusedError
from statemachine.journal import Journal
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
        with SignalWatch():
            self.devices.close()
            self._lock.__exit__(None, None, None)
            if self.simulated is not None:
                self.simulated.close()

    # --- jobs ---

    def run(self, job: str | Path = "pot", observer: Observer | None = None) -> RunOutcome:
        """Run a job to its end and write its folder. Raises only for what is wrong before anything moves.

        A simulated cell that has no calibration is calibrated first; a real one is not: `CalibrationStale`.
        """
        loaded, mesh = load_job(job)
        nominal = NominalSurface.load(mesh, unit=loaded.surface.mesh_unit)
        try:
            calibration = self.calibration()
        except CalibrationStale:
            if self.simulated is None:
                raise
            if observer is not None:
                observer(Event("note", None, {"text": "this simulated cell has no calibration yet: calibrating first"}))
            calibration = self.calibrate(observer, job)
        folder = new_run(self.runs_folder)
        self._keep_inputs(folder, Path(job), loaded, calibration)
        journal = Journal(folder, folder.name, self._info(loaded, calibration))
        started = time.time()
        witness = Witness(self.config.cell.truth) if self.config.cell.truth else None
        try:
            with FrameStore(folder / "frames") as frames:
                work = JobWork(self.config, loaded, nominal, calibration, self.devices, frames, folder)
                runner = Runner(
                    Sequence(), work.steps(), Policy(), journal, self.devices.clock, classify,
                    lambda reason: self.stop(), _both(observer, witness), self._recover,
                )  # fmt: skip
                result = runner.run()
        finally:
            journal.close()
        with SignalWatch():
            report = make_report(
                folder, self.config, loaded, nominal, work.repeatability, result, self._info(loaded, calibration),
                started, witness,
            )  # fmt: skip
            write_json(folder / REPORT, report)
        return RunOutcome(report["outcome"], report["reason"], folder, report, result.signal is not None)

    def _recover(self, error: BaseException) -> None:
        if isinstance(error, DeviceError) and error.device in ("arm", "laser", "claw"):
            self.devices.arm.recover()

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

    def _keep_inputs(self, folder: Path, job: Path, loaded: Job, calibration: CellCalibration) -> None:
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

            call = Call(what, lambda: made.append(work(check)))
            while not call.done.wait(0.05) and signals.reason is None:
                pass
            if signals.reason is not None or call.error is not None:
                self.devices.stop()
                call.done.wait(5.0)
                problems = self.devices.stop()  # once more: the work may have begun something before it saw the end
                unconfirmed = f"; not confirmed: {'; '.join(problems)}" if problems else ""
                if signals.reason is not None:
                    raise KeyboardInterrupt(f"{what} {signals.reason}; the cell was stopped{unconfirmed}")
                if call.error is not None:
                    call.error.add_note(unconfirmed)
                    raise call.error
        return made[0]


def _both(first: Observer | None, second: Observer | None) -> Observer:
    """One observer that tells two."""
    observers = [observer for observer in (first, second) if observer is not None]

    def tell(event: Event) -> None:
        for observer in observers:
            observer(event)

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
