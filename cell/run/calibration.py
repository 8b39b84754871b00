"""The cell's work on its own calibration: find it, make one over the boards on the deck, see how good it is today."""

import os
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from cell.base.storage import sealed, write_json
from cell.config.calibrations import store
from cell.config.calibrations.finding import find_calibration
from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import CellConfig
from cell.config.job import Job, load_job
from cell.devices.devices import Devices
from cell.measure.calibration.archive import Observations, write_archive
from cell.measure.calibration.drift.timing import TimesRefused
from cell.motion.kinematics import kinematics_name
from cell.procedures.arm.moves import Mover
from cell.procedures.calibrate.boards import collect_scan, collect_target
from cell.procedures.calibrate.reference_plate import see_reference_plate, with_edge
from cell.procedures.calibrate.timing import collect_timing, look_at_shutter
from cell.procedures.calibrate.verification import Verification, collect_verification, keep_confirmed
from cell.run.folder import REPORT, new_folder, release, run_log, when
from cell.run.recorded_work import WorkContext
from cell.run.runs import Run
from cell.run.session import warm_up as ahead
from cell.run.session.session import OpenCell
from drivers.errors import CalibrationStale, CellError
from drivers.interfaces import Device, why_untold
from statemachine.journal import Journal
from statemachine.step import Event


def serial_numbers(devices: Devices) -> dict[str, str]:
    """Of the devices that a calibration belongs to, by name; asked from the devices themselves. One that is simulated
    beside real ones says so: what was calibrated with it never passes for a real one's, nor the other way round."""
    owners: dict[str, Device] = {n: getattr(devices, n) for n in ("arm", "rail", "scan_camera", "target_camera")}
    simulated = () if devices.following is None else devices.following.simulated
    return marked({name: owner.identity().serial for name, owner in owners.items()}, simulated)


def marked(serials: dict[str, str], simulated: Collection[str]) -> dict[str, str]:
    """Serial numbers by device name, with those of the `simulated` ones marked as such."""
    return {name: f"simulated-{serial}" if name in simulated else serial for name, serial in serials.items()}


def arm_table(config: CellConfig, devices: Devices) -> str:
    """What the kinematics is called that the arm's controller computes with, and the cell after it."""
    return kinematics_name(config.arm.model, devices.arm.link_table())


def stored(cell: OpenCell) -> CellCalibration:
    """The stored calibration of this very cell as configured; see `find_calibration`, also for what it raises."""
    found = find_calibration(
        cell.calibrations_folder, serial_numbers(cell.devices), cell.config.calibration_hash(),
        max_age=cell.config.calibration.max_age, kinematics=arm_table(cell.config, cell.devices),
        untold=why_untold(cell.devices.arm),
    )  # fmt: skip
    store.require_as_configured(found, cell.config)
    return found


def observe_boards(
    config: CellConfig, devices: Devices, mover: Mover, context: WorkContext, notify: Callable[[float, str], None]
) -> Observations:
    """Photograph the boards on the deck from the calibration poses, and the reference plate between them."""
    given = config, devices, mover, context.check
    scan = collect_scan(*given, lambda f, t: notify(0.65 * f, t), context.keep)
    witness = see_reference_plate(config, devices, context.keep)
    target = collect_target(*given, lambda f, t: notify(0.65 + 0.3 * f, t), context.keep)
    return store.gathered(
        scan, target, serial_numbers(devices), config=config, kinematics=arm_table(config, devices), witness=witness
    )


def calibrate(cell: OpenCell, run: Run[object], job: str | Path) -> CellCalibration:
    """Move through the calibration poses, solve, and store the result and what it came from, recorded in `run`. `job`
    names the part that may be in the claw. Raises `CellError`, before anything moves, where it cannot be stored."""
    _require_writable(cell.calibrations_folder)
    ahead.begin()
    part_of, _ = load_job(job)
    config, devices = cell.config, cell.devices

    notify = partial(_notify, run, "calibrate")

    def work(context: WorkContext) -> tuple[Observations, CellCalibration]:
        mover = cell.mover(part_of, context.safe_point)
        # In command, so that a vehicle that somebody else moves or releases is noticed.
        devices.vehicle.recover()
        observations = observe_boards(config, devices, mover, context, notify)
        notify(0.96, "solving")
        made = store.solve_observations(observations).calibration
        notify(0.98, "looking at the scan camera's shutter")
        with kept_if_refused(cell.calibrations_folder, made.name):
            made = look_at_shutter(config, devices, mover, calibration=made, check=context.check, keep=context.keep)
        made = with_edge(config, devices, context.keep, made)
        return replace(observations, witness=made.scan.witness), made

    info = {"for_job": str(job)} if run.kind == "job" else None
    observations, calibration = cell.recorded(run, "calibration", work, info)
    write_archive(store.archive_of(cell.calibrations_folder, calibration), observations)
    store.save_calibration(calibration, cell.calibrations_folder / f"{calibration.name}.json")
    notify(1.0, "stored")
    return calibration


def _require_writable(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            # A full disk takes an empty file.
            file.write(bytes(1_000_000))
    except OSError as error:
        raise CellError(
            f"no calibration can be stored in {folder}: {error}. `df -h` tells whether the disk is full, `ls -ld` who "
            "may write"
        ) from error


@contextmanager
def kept_if_refused(folder: Path, name: str) -> Iterator[None]:
    """What is refused of the camera's times in this block holds for the stored calibration as well, and is kept there.
    Else jobs would go on with one that was made before the camera was set otherwise."""
    try:
        yield
    except TimesRefused as refused:
        for path in folder.glob("*.json"):
            # One that cannot be read, or was edited, is not used anyway.
            with suppress(CalibrationStale):
                old = store.read_calibration(path)
                if old.name == name:
                    store.save_calibration(replace(old, scan=replace(old.scan, refused=str(refused))), path)
        raise


def _notify(run: Run[object], step: str, fraction: float, text: str) -> None:
    run.notify(Event("progress", step, {"fraction": fraction, "text": text}))


def _ready(cell: OpenCell, context: WorkContext, calibration: CellCalibration, job: Job) -> Mover:
    """The arm's moves for work on this calibration, with the vehicle in command: one that is released is noticed."""
    mover = cell.mover(job, context.safe_point)
    cell.devices.interlocks.work_with(calibration.configuration)
    cell.devices.vehicle.recover()
    return mover


def verify(cell: OpenCell, run: Run[object], calibration: CellCalibration, job: Job) -> Verification:
    """Look at the deck boards again, recorded in `run`: how good `calibration` is, and what place error of `job`. What
    it finds out about the laser is kept with the stored calibration."""
    notify = partial(_notify, run, "verify")

    def work(context: WorkContext) -> Verification:
        mover = _ready(cell, context, calibration, job)
        seen = collect_verification(
            cell.config, cell.devices, mover, calibration=calibration, check=context.check, progress=notify,
            keep=context.keep,
        )  # fmt: skip
        return Verification.of(calibration, job, seen)

    made = cell.recorded(run, "verification", work)
    keep_confirmed(cell.calibrations_folder, calibration, made)
    notify(1.0, "done")
    return made


def time_stamps(cell: OpenCell, run: Run[object], calibration: CellCalibration, job: Job) -> CellCalibration:
    """Sweep to and fro over the fine board, recorded in `run`: `calibration`, stored with how late the scan camera's
    time stamps come. `job` names the part that may be in the claw."""
    notify = partial(_notify, run, "timing")

    def work(context: WorkContext) -> CellCalibration:
        mover = _ready(cell, context, calibration, job)
        with kept_if_refused(cell.calibrations_folder, calibration.name):
            timing = collect_timing(
                cell.config, cell.devices, mover, calibration, check=context.check, progress=notify, keep=context.keep
            )
        return replace(calibration, scan=replace(calibration.scan, timing=timing))

    made = cell.recorded(run, "timing", work)
    store.save_calibration(made, cell.calibrations_folder / f"{made.name}.json")
    notify(1.0, "stored")
    return made


@contextmanager
def recorded_maintenance(root: Path, facts: Mapping[str, object], reason: str, lift: Sequence[str]) -> Iterator[None]:
    """A run of kind "maintenance" below `root` for as long as the context is open. `CellError` if it cannot be kept."""
    started = time.time()
    facts = {"kind": "maintenance", "pid": os.getpid(), **facts, "maintenance": reason, "lifted": list(lift)}
    with new_folder(root) as folder:
        journal = Journal(folder, folder.name, facts)
    outcome, said = "done", f"maintenance done: {reason}"
    try:
        with run_log(folder):
            yield
    except BaseException as error:
        outcome, said = "faulted", f"maintenance ({reason}) ended by {type(error).__name__}: {error}"
        raise
    finally:
        journal.run_ended(outcome, said)
        journal.close()
        ended = {"started": when(started), "ended": when(time.time()), "wall_s": round(time.time() - started, 2)}
        report = {"run": folder.name, "version": release(), "outcome": outcome, "reason": said, **ended, **facts}
        write_json(folder / REPORT, sealed(report))
