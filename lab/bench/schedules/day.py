"""One schedule on one virtual cell: the product's own runs, what happens to them, and the judge of it.

Everything happens in the thread of the run, after a tick of the virtual clock or where the run tells an event, so the
same schedule takes the same course. People ask through the journal, as another process would.
"""

import shutil
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from cell.base.compiled import load
from cell.config.cell_config import CellConfig, default_toml, load_config
from cell.config.job import Job, job_and_item, load_job
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from cell.procedures.arm.moves import PartState
from cell.run.job_run import RunOutcome
from cell.run.runs import Run
from cell.run.session.session import OpenCell
from cell.run.session.supervisor import Cell
from drivers.errors import CellError
from lab.bench.schedules.acts import Computer, LeftRun, do_to_world, make_well
from lab.bench.schedules.oracle import Oracle, RunEnd, Violation
from lab.bench.schedules.schedule import CLAW, WORLD_ACTS, Entry, Schedule
from statemachine.journal import JournalError, read, request
from statemachine.step import Event, Observer

WATCHED_S = 3.0
"""So long, s of the cell, is looked at after each end."""
SESSIONS = 3
"""A run that did not come to its end is resumed at most so often, less one."""
BY = "the day's person"
ABORT = "a day's abort"

Made = TypeVar("Made")


@dataclass(frozen=True)
class DayRecord:
    """What became of a schedule: `ends` of each run (outcome and reason), and where each entry happened. `met` has the
    state or step, the act, and how the run ended in which it happened."""

    schedule: Schedule
    ends: tuple[tuple[str, str], ...]
    met: tuple[tuple[str, str, str], ...]
    violations: tuple[Violation, ...]


class _Session(Cell):
    """The cell as a program opens it, whose runs the `day` hears before they go on."""

    def __init__(self, opened: OpenCell, day: "Day") -> None:
        super().__init__(opened)
        self._day = day

    def begin(
        self, kind: str, work: Callable[[Run[Made]], Made], observer: Observer | None = None, stops: int | None = None
    ) -> Run[Made]:
        """See `Cell.begin`."""

        def heard(run: Run[Made]) -> Made:
            notify = run.notify

            def both(event: Event) -> None:
                notify(event)
                self._day.hear(run, event)

            run.notify = both  # type: ignore[method-assign]
            return work(run)

        return super().begin(kind, heard, observer, stops)


class _OneWorld(VirtualCell):
    """A cell whose station nobody sets up anew for a resumed run: it finds the part where the run before left it."""

    def make_ready(self, described: Described) -> None:
        """All was ready when the world was drawn; another item becomes the present one."""
        if described.drawing(self._truth).as_json() != self.world.scene.drawing.as_json():
            super().make_ready(described)


def _item_before(job: Job) -> str | None:
    """The item before this one, where it is at another stop: the vehicle comes from there."""
    name, number = job_and_item(job.job.name)
    there = job.item[number - 2].stop if job.stop and number is not None and number > 1 else job.at_stop
    return None if there == job.at_stop else f"{name}#{(number or 2) - 1}"


def configuration(folder: Path) -> CellConfig:
    """The cell as it ships, of a folder of its own; its runs leave no record and picture."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "cell.toml"
    path.write_text(default_toml().replace("record = true", "picture = false\nrecord = false"), encoding="utf-8")
    return load_config(path)


def calibrate(seed: int, level: str, folder: Path, job: str = "pot") -> Path:
    """Calibrate the cell of `seed` and `level` in `folder`, and give the folder of its calibrations."""
    load()
    config = configuration(folder)
    virtual = VirtualCell(config, seed, level, Described.of(job))
    with Cell(OpenCell(config, folder, nullcontext(), virtual.devices, virtual)) as cell:
        cell.calibrate(job=job)
        return cell.calibrations_folder


class Day:
    """A schedule as it is carried out in `folder`, with the stored `calibrations` of its cell."""

    def __init__(self, schedule: Schedule, folder: Path, calibrations: Path) -> None:
        load()
        self._schedule, self._folder = schedule, folder
        self._config = configuration(folder)
        shutil.copytree(calibrations, folder / self._config.cell.calibrations, dirs_exist_ok=True)
        self._job = load_job(schedule.job)[0]
        self._item_before = _item_before(self._job)
        described = Described.of(self._item_before or schedule.job)
        self._virtual = _OneWorld(self._config, schedule.seed, schedule.level, described)
        self._clock = self._virtual.clock
        home = PartState.first(self._job).value
        self.oracle = Oracle(self._virtual.world, self._virtual.scan_camera.model, schedule.level, home)
        self._computer = Computer()
        self._start = self._planar()
        self._waiting = list(schedule.entries)
        self._pauses: list[Entry] = []
        self._met: list[tuple[str, str]] = []
        self._failure: BaseException | None = None
        self._quiet = False
        self._begin()

    def _begin(self) -> None:
        """A program opens the cell: nothing of a run before it is in the way."""
        self._run: Run[object] | None = None
        self._step = ""
        self._begun: dict[str, float] = {}
        self._left: LeftRun | None = None
        self._cut: Entry | None = None
        self.oracle.begun()

    def perform(self) -> DayRecord:
        """Run the job, resume it as long as that is possible, and tell what the judge found."""
        ends: list[tuple[str, str]] = []
        met: list[tuple[str, str, str]] = []
        before: Path | None = None
        with self._computer, self._rung(self.oracle.tick), self._rung(self._look):
            for _ in range(SESSIONS):
                outcome, reason, before = self._session(before)
                ends.append((outcome, reason))
                met += [(*where, outcome) for where in self._met]
                self._met.clear()
                if before is None:
                    break
                make_well(self._virtual)
        if self._failure is not None:
            raise self._failure
        return DayRecord(self._schedule, tuple(ends), tuple(met), tuple(self.oracle.violations))

    def _planar(self) -> tuple[float, float, float]:
        return self._virtual.world.vehicle.planar(self._clock.now())

    def _rung(self, call: Callable[[], None]) -> AbstractContextManager[None]:
        """Inside this context `call` is called after each tick."""

        def ring() -> float:
            try:
                call()
            except Exception as error:
                self._failure = self._failure or error
            return 0.0

        return self._clock.alarm(0.0, ring)

    def _session(self, before: Path | None) -> tuple[str, str, Path | None]:
        """Run the job, or resume the run `before`: outcome and reason, and the run that can be resumed next."""
        self._begin()
        self._resumes = before is not None
        opened = OpenCell(self._config, self._folder, nullcontext(), self._virtual.connected(), self._virtual)
        with _Session(opened, self) as cell:
            try:
                if before is None:
                    if self._item_before is not None:
                        self._come_from(cell, self._item_before)
                    outcome = cell.run(self._schedule.job, at_start=self._item_before is None)
                else:
                    # The world goes on: the vehicle stands where the run before left it.
                    cell.whereabouts.forget_word()
                    self.oracle.did("resume")
                    outcome = cell.resume(before.name, at_start=self._planar() == self._start)
            except CellError as error:
                if before is not None and self._run is None:
                    self.oracle.unresumed(str(error), self._torn(before))
                    return "not resumed", str(error), None
                return "not begun", str(error), None
            finally:
                self._computer.free_disk()
                self._clock.sleep(WATCHED_S)
        return self._ended(outcome)

    def _come_from(self, cell: Cell, item: str) -> None:
        """Do an item at another stop, with nothing that happens, as the first of the day."""
        self._quiet = True
        done = cell.run(item, at_start=True)
        self._quiet = False
        if done.outcome != "placed":
            raise CellError(f"{item}, with nothing that happened, ended {done}")

    def _ended(self, outcome: RunOutcome) -> tuple[str, str, Path | None]:
        if self._left is not None:
            # What a process would have written after its death is not there.
            self._left.restore()
            return self._left.act, "", outcome.folder
        bound, nest = outcome.report.get("place_bound_95") or {}, self._job.nest
        place = nest if self._job.unloads and nest is not None else self._job.place
        self.oracle.ended(
            RunEnd(
                outcome.outcome, outcome.reason, self._told_of_part(outcome.folder),
                tolerance=place.tolerance, bound=1e-3 * bound["d"] if "d" in bound else None,
            )
        )  # fmt: skip
        return outcome.outcome, outcome.reason, outcome.folder if outcome.outcome in ("aborted", "faulted") else None

    def _told_of_part(self, folder: Path) -> str | None:
        """What the journal tells last of the part; a resumed run may begin with it in the claw."""
        record = read(folder)
        begun = PartState.HELD.value if "held" in record.run.info else None
        return next((str(e.data["part"]) for e in reversed(record.events) if "part" in e.data), begun)

    def _torn(self, folder: Path) -> bool:
        """Whether the journal may lack something: it is damaged, or the disk was full."""
        try:
            read(folder, whole=True)
        except JournalError:
            return True
        return "full_disk" in self.oracle.acts or "power_cut" in self.oracle.acts

    def hear(self, run: Run[object], event: Event) -> None:
        """An event of a run, before the run goes on."""
        if self._quiet:
            return
        try:
            self._hear(run, event)
        except Exception as error:
            self._failure = self._failure or error
            run.abort(f"the day itself failed: {error}")

    def _hear(self, run: Run[object], event: Event) -> None:
        if self._left is None:
            self._follow(run, event)
        if self._cut is not None and event.kind != "progress":
            self._leave(run, self._cut)
        if event.kind == "run_ended":
            self.oracle.stopped()

    def _follow(self, run: Run[object], event: Event) -> None:
        step = event.step or self._step
        match event.kind:
            case "state" if self._run is None:
                self._run, self._begun[""] = run, self._clock.now()
                if self._resumes:
                    self.oracle.resumed()
            case "step_started":
                self._step = step
                self._begun.setdefault(step, self._clock.now())
            case "step_done":
                for entry in [entry for entry in self._waiting if entry.step == step and entry.act != "late_word"]:
                    self._do(run, entry)
            case "note" if event.data.get("part") == PartState.UNKNOWN.value:
                self._begun[CLAW] = self._clock.now()
                self._look()
            case "paused":
                held, self._pauses = self._pauses, []
                self._hold(run, held)
                self._ask(run, "go-on", BY)
            case "confirm_needed":
                late = [entry for entry in self._waiting if entry.act == "late_word"][:1]
                for entry in late:
                    self._met.append((step, entry.act))
                    self._waiting.remove(entry)
                self._hold(run, late)
                self._ask(run, "confirm", BY, int(str(event.data["number"])))

    def _look(self) -> None:
        if (run := self._run) is None or run.control.over or self._left is not None:
            return
        now = self._clock.now()
        for entry in list(self._waiting):
            begun = self._begun.get(entry.step)
            if entry.act != "late_word" and begun is not None and now >= begun + entry.after_s:
                self._do(run, entry)

    def _do(self, run: Run[object], entry: Entry) -> None:
        if entry not in self._waiting:
            return
        self._waiting.remove(entry)
        self._met.append((self._step, entry.act))
        self._happen(run, entry)

    def _happen(self, run: Run[object], entry: Entry) -> None:
        self.oracle.did(entry.act)
        match entry.act:
            case "pause":
                self._pauses.append(entry)
                self._ask(run, "pause", BY)
            case "abort":
                self._ask(run, "abort", ABORT)
            case "kill":
                self._leave(run, entry)
            case "power_cut":
                self._cut = entry
            case "full_disk":
                self._computer.fill_disk()
            case "clock_step":
                self._computer.step_clock(entry.amount)
            case act if act in WORLD_ACTS:
                do_to_world(self._virtual, entry)
            case fault:
                self._virtual.fault(fault)

    def _hold(self, run: Run[object], entries: list[Entry]) -> None:
        """Time passes while the run waits for a person, and things happen meanwhile."""
        with self._clock.checking(lambda: None):
            for entry in entries:
                if entry.meanwhile:
                    self._happen(run, Entry(entry.meanwhile))
                self._clock.sleep(entry.amount)

    def _ask(self, run: Run[object], kind: str, reason: str, number: int | None = None) -> None:
        """As another process asks; where the disk is full, whoever asks makes room first."""
        if run.folder is not None and self._left is None:
            self._computer.free_disk()
            request(run.folder, kind, reason, number)

    def _leave(self, run: Run[object], entry: Entry) -> None:
        """The process is gone: its files stay as they are, and what the devices do without it is a stop."""
        self._cut = None
        if self._left is None and run.folder is not None:
            self._left = LeftRun.taken(run.folder, entry)
            run.abort("its process is gone")


def perform(schedule: Schedule, calibrations: Path) -> DayRecord:
    """The day of a schedule, in a folder that is deleted after it."""
    with tempfile.TemporaryDirectory(prefix="cell-day-") as folder:
        return Day(schedule, Path(folder), calibrations).perform()
