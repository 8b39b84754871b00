"""The cell as a program sees it: open it, run jobs, calibrate, stop, close.

with Cell.open("cell.toml", sim="all", seed=7) as cell:
    result = cell.run(job="pot")
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from cell.assembly import Devices, connect
from cell.calibration.archive import Observations
from cell.config import CellConfig, load_config
from cell.guard import guarded
from cell.injection import Injection, Injector
from cell.inversion import NominalSurface
from cell.job import Job, load_job, require_fit
from cell.job_run import JobRun, Observer, RunOutcome, both, stop_cell
from cell.resumption import UnfinishedRun, job_source
from cell.runs import CellLock, find_run
from cell.simulation import SimulatedCell, with_endpoints
from cell.steps.approach import Odometry
from cell.steps.collect import collect_scan, collect_target
from cell.steps.moves import HOME, Mover
from cell.steps.verification import Verification
from cell.steps.verify import collect_verification
from cell.stored_calibration import (
    CellCalibration,
    find_calibration,
    gathered,
    save_with_observations,
    solve_observations,
)
from drivers.errors import CalibrationStale, ConfigError
from statemachine.runner import Event
from statemachine.watch import SignalWatch

SIM_SPEED = 3.0
"""How many times faster than the wall a simulated cell runs unless told otherwise."""

Made = TypeVar("Made")


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
        stop_cell(self.devices)

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

    def run(self, job: str | Path = "pot", observer: Observer | None = None, inject: Sequence[str] = ()) -> RunOutcome:
        """Run a job to its end and write its folder. Raises only for what is wrong before anything moves.

        A simulated cell that has no calibration is calibrated first; a real one is not: `CalibrationStale`. `inject`
        schedules faults of a simulated cell, such as "arm.protective_stop@laser_sweep:40%".
        """
        injections = [Injection.parse(text) for text in inject]
        if injections and self.simulated is None:
            raise ConfigError(f"{injections[0]} can only happen to a simulated cell")
        info: dict[str, Any] = {}
        if injections:
            info["injected"] = [str(injection) for injection in injections]
            observer = both(observer, Injector(self.config.cell.truth, injections))
        return self._perform(job, observer, info, None)

    def resume(self, run: str | Path | None = None, observer: Observer | None = None) -> RunOutcome:
        """Do the job of a run that was aborted, faulted or cut short, as a new run; without `run` the newest.

        The vehicle stays where it stands if it sees the board from there, and what was swept is not swept again if
        the board has not moved. Raises `ConfigError` when there is nothing to resume.
        """
        before = UnfinishedRun.find(find_run(self.runs_folder, None if run is None else str(run)))
        return self._perform(before.job, observer, {"resumed_from": before.folder.name}, before)

    def _perform(
        self, job: str | Path, observer: Observer | None, info: dict[str, Any], before: UnfinishedRun | None
    ) -> RunOutcome:
        loaded, mesh = load_job(job)
        require_fit(loaded, self.config)
        nominal = NominalSurface.load(mesh, unit=loaded.surface.mesh_unit)

        def note(text: str) -> None:
            if observer is not None:
                observer(Event("note", None, {"text": text}))

        try:
            calibration = self.calibration()
        except CalibrationStale:
            if self.simulated is None:
                raise
            note("this simulated cell has no calibration yet: calibrating first")
            calibration = self.calibrate(observer, job)
        info |= {"simulated": self.simulated is not None, "seed": None, "level": None, **job_source(job)}
        if self.simulated is not None:
            info |= {key: self.simulated.endpoints[key] for key in ("seed", "level")}
        earlier = None
        if before is not None:
            earlier, why = before.sweep(loaded, self.config, calibration)
            note(why if earlier is not None else f"{why}: sweeping again")
        job_run = JobRun(self.config, self.devices, loaded, nominal, calibration, info, observer, earlier)
        outcome, self._odometry = job_run.perform(self.runs_folder, self._odometry)
        return outcome

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
        """Move through the calibration poses over the deck boards, solve, and store the result and what it came from.

        `job` names the part that may be in the claw, so that it does not touch anything on the way.
        """
        part_of, _ = load_job(job)

        def tell(fraction: float, text: str) -> None:
            if observer is not None:
                observer(Event("progress", "calibrate", {"fraction": fraction, "text": text}))

        def work(check: Callable[[], None]) -> tuple[Observations, CellCalibration]:
            mover = self.mover(part_of)
            self.devices.vehicle.brake()
            scan = collect_scan(self.config, self.devices, mover, check, lambda f, t: tell(0.65 * f, t))
            target = collect_target(self.config, self.devices, mover, check, lambda f, t: tell(0.65 + 0.3 * f, t))
            tell(0.96, "solving")
            observations = gathered(scan, target, self._identities(), self.config)
            return observations, solve_observations(observations).calibration

        observations, calibration = self.guarded("calibration", work)
        save_with_observations(calibration, observations, self.calibrations_folder)
        tell(1.0, "stored")
        return calibration

    def verify(self, observer: Observer | None = None, job: str | Path = "pot") -> Verification:
        """Look at the deck boards again and say how good the stored calibration is today.

        Raises `CalibrationStale` when there is none, or one without a reference; `RefusedError` when a board is not
        seen. `job` names the part that may be in the claw and what the place error is reckoned for.
        """
        loaded, _ = load_job(job)
        calibration = self.calibration()

        def tell(fraction: float, text: str) -> None:
            if observer is not None:
                observer(Event("progress", "verify", {"fraction": fraction, "text": text}))

        def work(check: Callable[[], None]) -> Verification:
            self.devices.vehicle.brake()
            mover = self.mover(loaded)
            seen = collect_verification(self.config, self.devices, mover, calibration, check, tell)
            return Verification.of(calibration, loaded, seen)

        verification = self.guarded("verification", work)
        tell(1.0, "done")
        return verification

    def home(self) -> None:
        """Home the rail and fold the arm above the deck."""

        def work(check: Callable[[], None]) -> None:
            self.devices.rail.home().wait(60.0)
            self.mover(None).to_joints(HOME)

        self.guarded("homing", work)

    def guarded(self, what: str, work: Callable[[Callable[[], None]], Made]) -> Made:
        """Do `work` outside a job; see `cell.guard.guarded`."""
        return guarded(self.devices, what, work)
