"""The order of the checks, and going through them: what is good already is passed over, what was found is mended.

First what does not move, then each axis by itself and slowly, then what a wrong axis would make dangerous.

What was found is written into the TOML file; comments, order and spaces of the rest stay. The new text is parsed again
and has to say what was meant; else nothing is written. The old file is always kept."""

import hashlib
import shutil
import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from cell.apps.commission.check import CheckVerdict, CommissionCheck, Progress, Result
from cell.apps.commission.checks import arm, cameras, outputs, rail, stops, vehicle, whole_cell
from cell.apps.commission.workplace import CommissionWorkplace, Declined, Person
from cell.base.storage import replacing
from cell.config.cell_config import CONFIGURATION, load_config, require_confirm
from cell.config.job import job_path
from cell.run.recorded_work import WorkContext
from cell.run.session.supervisor import Cell
from drivers.errors import Aborted, CellError, ConfigError, DeviceFault, RefusedError
from drivers.interfaces import Frame


def edited(text: str, changes: Mapping[str, str]) -> str:
    """`text` with each dotted key of `changes` set to its value, given as TOML. `ConfigError` when that fails."""
    wanted = tomllib.loads(text)
    try:
        document = tomlkit.parse(text)
        for key, value in changes.items():
            table, _, name = key.rpartition(".")
            _table(document, table)[name] = tomlkit.value(value)
            _table(wanted, table)[name] = tomllib.loads(f"x = {value}")["x"]
        new = document.as_string()
        good = tomllib.loads(new) == wanted
    except (TOMLKitError, tomllib.TOMLDecodeError, TypeError):
        good = False
    if not good:
        raise ConfigError(
            "the configuration is written in a way that this program does not change without risk; write yourself: "
            + "; ".join(f"{key} = {value}" for key, value in changes.items())
        )
    return new


def write_changes(path: Path, changes: Mapping[str, str]) -> Path:
    """Change the file, and keep the old one beside it; returns where that is. `ConfigError` when it cannot be done."""
    try:
        new = edited(path.read_bytes().decode("utf-8-sig"), changes)
        stamp = time.strftime("%Y%m%d-%H%M%S")
        names = [f"{path.name}.before-{stamp}", *(f"{path.name}.before-{stamp}-{k}" for k in range(2, 100))]
        backup = next(path.with_name(name) for name in names if not path.with_name(name).exists())
        shutil.copy2(path, backup)
        with replacing(path) as file:
            shutil.copymode(path, file.name)
            file.write(new.encode())
    except OSError as error:
        raise ConfigError(f"{path} cannot be changed: {error.strerror or error}; see its permissions") from error
    return backup


def _table(tables: Any, dotted: str) -> Any:
    for part in dotted.split("."):
        tables = tables.setdefault(part, {})
    return tables


CHECKS: tuple[CommissionCheck, ...] = (
    *whole_cell.LINK_CHECKS, *arm.CHECKS, *cameras.CHECKS, *rail.CHECKS, *outputs.CHECKS, *vehicle.CHECKS,
    *stops.CHECKS, *vehicle.STATION_CHECKS, *whole_cell.CLOSING_CHECKS,
)  # fmt: skip
MENDS = 3
"""How often at most what a check found is written, and the check done again."""


@dataclass
class Commissioning:
    """Runs the checks at a `workplace`. `path` is cell.toml; `show(check, verdict, result)` is called after each."""

    workplace: CommissionWorkplace
    progress: Progress
    path: Path
    show: Callable[[CommissionCheck, str, Result | None], None]

    def go(self, checks: Sequence[CommissionCheck]) -> bool:
        """Do these checks in their order; True when all of them are good."""
        good = True
        for check in checks:
            if self._good(check):
                self.show(check, "good already", None)
                continue
            if missing := [name for name in check.needs if not self._good(by_name(name))]:
                self.show(check, f"waits for {', '.join(missing)}", None)
                good = False
                continue
            good = self._until_good(check) and good
        return good

    def _good(self, check: CommissionCheck) -> bool:
        """Whether it and all that it rests on came out well."""
        good = self.progress.standing(check, self.workplace.config) == CheckVerdict.GOOD
        return good and all(self._good(by_name(name)) for name in check.needs)

    def _until_good(self, check: CommissionCheck) -> bool:
        """Do a check, mend what it found, and do it again, as often as that helps."""
        mended = 0
        while True:
            result = self._once(check)
            self.show(check, result.verdict.value, result)
            if result.verdict is CheckVerdict.GOOD:
                return True
            if mended < MENDS and self._mend(check, result):
                mended += 1
            elif not self._again(check, result):
                return False

    def _once(self, check: CommissionCheck) -> Result:
        result, begun = Result(), time.monotonic()
        workplace, run = self.workplace, ""
        try:
            if check.recorded:
                run = self._recorded(check, result)
            else:
                check.work(workplace, result)
        except Declined as declined:
            result.verdict = CheckVerdict.DECLINED
            result.notes.append(str(declined))
        except Aborted:
            raise
        except CellError as error:
            result.verdict = CheckVerdict.FAILED
            result.notes.append(" ".join(str(error).split()))
            if isinstance(error, RefusedError) and isinstance(frame := error.seen.get("frame"), Frame):
                workplace.keep(result, f"{check.name}-refused", frame)
            if isinstance(error, DeviceFault):
                # Whatever it was: what follows begins with devices that are asked anew.
                workplace.close()
        self.progress.keep(check, workplace.config, result, time.monotonic() - begun, run)
        return result

    def _recorded(self, check: CommissionCheck, result: Result) -> str:
        """Do it as a run, so that it is in `cell runs` and hears `cell abort`; returns the run's name."""
        workplace = self.workplace
        name: list[str] = []

        def work(context: WorkContext) -> None:
            # Done again after a fault that a person has confirmed: without what was noted before it.
            vars(result).update(vars(Result()))
            current = workplace.cell.current
            if current is not None and current.folder is not None:
                name[:] = [current.folder.name]
            workplace.context = context
            try:
                check.work(workplace, result)
            finally:
                workplace.context = None

        workplace.cell.perform("commission", work, workplace.heard, {"check": check.name})
        return name[0] if name else ""

    def _mend(self, check: CommissionCheck, result: Result) -> bool:
        """Write what was found into the configuration, if a person agrees; True when something was written."""
        changes: dict[str, str] = {}
        in_job: dict[str, str] = {}
        for finding in result.findings:
            changes |= finding.write
            in_job |= finding.write_job
        job = job_path(self.workplace.job_file)
        wanted = [(path, keys) for path, keys in ((self.path, changes), (job, in_job)) if keys]
        shown = ", and ".join(
            f"into {path.name}: " + "; ".join(f"{key} = {value}" for key, value in keys.items())
            for path, keys in wanted
        )
        if not wanted or not self.workplace.person.sees(f"Write {shown}? The old file is kept."):
            return False
        backups = [write_changes(path, keys) for path, keys in wanted]
        self.workplace.close()
        try:
            self.progress.work_for(self.workplace.job)
            self.workplace.connect()
        except ConfigError as error:
            self.workplace.close()
            for (path, _), backup in zip(wanted, backups, strict=True):
                backup.replace(path)
            self.progress.work_for(self.workplace.job)
            raise ConfigError(
                f"what was measured does not fit the configuration, which is as it was: {error}"
            ) from error
        for finding in result.findings:
            if finding.write or finding.write_job:
                self.progress.keep_mended(check, asdict(finding), ", ".join(backup.name for backup in backups))
        return True

    def _again(self, check: CommissionCheck, result: Result) -> bool:
        """Whether a person has changed something and wants the check done again."""
        if result.verdict is CheckVerdict.DECLINED:
            return False
        return self.workplace.person.again(f"{check.title}: {result.verdict.value}. Mend it and measure again now?")


def by_name(name: str) -> CommissionCheck:
    """The check of that name; `ConfigError` that lists them."""
    for check in CHECKS:
        if check.name == name:
            return check
    raise ConfigError(f'there is no check "{name}"; they are {", ".join(check.name for check in CHECKS)}')


def chosen(only: Sequence[str], until: str | None) -> list[CommissionCheck]:
    """The checks named, or all, up to and with `until`."""
    picked = [check for check in CHECKS if not only or check in [by_name(name) for name in only]]
    if until is not None:
        last = CHECKS.index(by_name(until))
        picked = [check for check in picked if CHECKS.index(check) <= last]
    if not picked:
        raise ConfigError(f"nothing would be checked: {', '.join(only)} comes after {until}; leave out --until")
    return picked


FOLDER = "commissioning"


def begin(
    config: Path | None, person: Person, show: Callable[[CommissionCheck, str, Result | None], None], *, job: str,
    sim: str | None = None, seed: int = 1, level: str = "nominal", clock: str = "wall", truth: Path | None = None,
) -> Commissioning:  # fmt: skip
    """A commissioning of the cell of this configuration, whose record is in `commissioning/` beside it.

    With `sim="all"` the cell is simulated, as `truth` describes it. `ConfigError` for what is wrong before anything is
    connected. The caller closes `workplace`.
    """
    path = Path(CONFIGURATION) if config is None else config
    if not path.is_file():
        raise ConfigError(
            f"there is no {path} to commission: `cell init` writes one; put in what you know, addresses first. Or try "
            "it with a simulated cell: `cell init`, then `cell commission --sim all`"
        )
    loaded = load_config(path)
    if sim is None:
        require_confirm(loaded)
    if truth is not None:
        load_config(truth)
    job_path(job)
    options: dict[str, Any] = {"sim": sim, "job": job}
    simulated = sim == "all" or (sim is None and bool(loaded.cell.truth))
    which: dict[str, Any] = {"name": loaded.cell.name, "simulated": simulated, "sim": sim, "job": job}
    if sim is not None:
        options |= {"seed": seed, "level": level, "clock": clock, "truth": truth}
        world = "" if truth is None else hashlib.sha256(truth.read_bytes()).hexdigest()[:12]
        which |= {"seed": seed, "level": level, "clock": clock, "world": world}
    folder = path.resolve().parent / FOLDER
    workplace = CommissionWorkplace(path, partial(Cell.open, path, **options), person, folder, job, simulated=simulated)
    return Commissioning(workplace, Progress(folder, which, workplace.job), path, show)


def confirms_itself(config: Path | None) -> bool:
    """Whether the configuration names a simulated cell that confirms by itself what a person has to."""
    path = Path(CONFIGURATION) if config is None else config
    return path.is_file() and load_config(path).cell.confirm == "simulated"
