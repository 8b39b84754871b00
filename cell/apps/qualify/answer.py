"""What the worlds of a campaign say: how many parts are placed, how near to limits, how fast, and what goes wrong.

The line that says so is kept for the job, and shown by `cell run` while it holds. Two campaigns on the same seeds are
compared world by world: the difference in yield and in each figure.
"""

import os
import re
import shlex
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import numpy as np

from cell.apps.qualify.campaign import Campaign
from cell.apps.qualify.identity import QualifiedCode, configuration_hash
from cell.apps.qualify.intervals import Share, cpk, mean_difference, share_difference
from cell.apps.qualify.rows import BOUNDS, ROWS, Row, RowStore, number, shown, used
from cell.base.storage import read_json, sealed, write_json
from cell.config.cell_config import load_config
from cell.config.files import beside, find_config
from cell.config.job import job_and_item, job_path, ships
from cell.run.batch import GOOD
from cell.run.resumption import job_hash
from drivers.errors import CellError, ConfigError
from drivers.interfaces import Vector

BAD = ("refused", "misplaced", "faulted", "aborted", "error")
NEAREST = 5
"""Figures whose worst world is told."""
NUMBER = re.compile(r"[-+±]?\d[\d.,]*")
FEW = 5
"""Values below which a Cpk says nothing."""


@dataclass(frozen=True)
class FigureSpread:
    """How a figure of the report lies beside its limit, over the `n` worlds that have it; the limit is the tightest.

    `p95` lies nearer to the limit than 95 % of the values do. `worst` uses most of its limit, the share `worst_used`.
    """

    name: str
    unit: str
    bound: str
    limit: float
    n: int
    mean: float
    sd: float
    p95: float
    worst: float
    worst_used: float
    worst_seed: int
    cpk: float | None


@dataclass(frozen=True)
class StepTime:
    """A step's mean time in seconds of the cell's clock, and its share of all steps."""

    name: str
    mean_s: float
    share: float


@dataclass(frozen=True)
class WorldReason:
    """Why worlds did not place, its numbers left out, and how many; `seed` is the first of them."""

    outcome: str
    step: str
    reason: str
    count: int
    seed: int


@dataclass(frozen=True)
class WorstWorld:
    """A world that did not place, or whose `figure` uses the share `used` of its limit; `command` repeats it."""

    seed: int
    outcome: str
    reason: str
    figure: str
    used: float | None
    command: str


@dataclass(frozen=True)
class CycleTime:
    """Seconds of the cell's clock over `n` good worlds."""

    n: int
    mean_s: float
    p95_s: float


@dataclass(frozen=True)
class JobAnswer:
    """What the first `worlds` seeds of a level from `first` on say; `seeds` are those, with their values in `rows`.

    `shares` are told by outcome: "placed" counts the corrected ones too. `covered` is of the true places within the
    stated 95 % bound, `unnoticed` of the placed parts outside the tolerance.
    """

    of: QualifiedCode
    level: str
    first: int
    worlds: int
    date: str
    shares: Mapping[str, Share]
    figures: Sequence[FigureSpread]
    cycle: CycleTime | None
    steps: Sequence[StepTime]
    covered: Share | None
    unnoticed: Share
    reasons: Sequence[WorldReason]
    worst: Sequence[WorstWorld]

    @classmethod
    def of_rows(
        cls, of: QualifiedCode, level: str, *, first: int, rows: Sequence[Row], command: Callable[[Row], str], date: str
    ) -> Self:
        """The answer of these rows; `command(row)` repeats a world."""
        good = [row for row in rows if row["outcome"] in GOOD]
        counts = Counter(str(row["outcome"]) for row in rows)
        corrected = sum(number(row.get("corrections")) > 0 for row in good)
        shares = {"placed": Share(len(good), len(rows)), "corrected": Share(corrected, len(rows))}
        shares |= {name: Share(counts[name], len(rows)) for name in BAD if counts[name] or name in BAD[:3]}
        true = [row for row in good if "true_error_max_mm" in row]
        outside = sum(number(row.get("true_error_max_mm")) > number(row.get("tolerance_mm")) for row in true)
        figures = figures_of(rows)
        covered = [number(row.get("points_covered")) for row in rows if "points_covered" in row]
        return cls(
            of, level, first, worlds=len(rows), date=date, shares=shares, figures=figures, cycle=_cycle(good),
            steps=_steps(good), covered=Share(sum(covered), len(covered)) if covered else None,
            unnoticed=Share(outside, len(true)), reasons=_reasons(rows), worst=_worst(rows, figures, command),
        )  # fmt: skip

    @property
    def yields(self) -> Share:
        """The share of good worlds."""
        return self.shares["placed"]

    @property
    def line(self) -> str:
        """In one line, as `cell run` shows it."""
        worlds = f"{self.worlds} world{'s' * (self.worlds != 1)}"
        return f"qualified {self.date}, {worlds} of {self.level}, yield {self.yields}"

    def as_dict(self) -> dict[str, object]:
        """JSON-ready."""
        return {
            **asdict(self.of), "level": self.level, "first_seed": self.first, "worlds": self.worlds, "date": self.date,
            "line": self.line, "shares": {name: share.as_dict() for name, share in self.shares.items()},
            "figures": [asdict(figure) for figure in self.figures],
            "cycle": None if self.cycle is None else asdict(self.cycle),
            "steps": [asdict(step) for step in self.steps],
            "covered": None if self.covered is None else self.covered.as_dict(),
            "unnoticed": self.unnoticed.as_dict(), "reasons": [asdict(reason) for reason in self.reasons],
            "worst": [asdict(world) for world in self.worst],
        }  # fmt: skip


def limited(rows: Sequence[Row]) -> dict[str, str]:
    """The columns of figures that have a limit, each with how the column of its limit ends."""
    found: dict[str, str] = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        for end in BOUNDS.values():
            if name.endswith(end):
                found[name.removesuffix(end)] = end
    return found


def values_of(rows: Sequence[Row], name: str, end: str) -> tuple[Vector, Vector, list[int]]:
    """The values (n,) of a figure, their limits (n,), and their seeds."""
    having = [row for row in rows if name in row and name + end in row]
    values = np.array([number(row.get(name)) for row in having])
    limits = np.array([number(row.get(name + end)) for row in having])
    return values, limits, [int(number(row.get("seed"))) for row in having]


def figures_of(rows: Sequence[Row]) -> list[FigureSpread]:
    """Each figure that has a limit, the nearest to it first."""
    found = []
    for name, end in limited(rows).items():
        values, limits, seeds = values_of(rows, name, end)
        at_least = end == BOUNDS["at least"]
        near = np.array([used(name, value, limit, end) for value, limit in zip(values, limits, strict=True)])
        worst = int(near.argmax())
        words, unit = shown(name)
        found.append(
            FigureSpread(
                words, unit, "at least" if at_least else "at most",
                limit=float(limits.max() if at_least else limits.min()), n=len(values), mean=float(values.mean()),
                sd=float(values.std(ddof=1)) if len(values) > 1 else 0.0,
                p95=float(np.percentile(values, 5) if at_least else np.percentile(np.abs(values), 95)),
                worst=float(values[worst]), worst_used=float(near[worst]), worst_seed=seeds[worst],
                cpk=cpk(values.tolist(), limits.tolist(), at_least=at_least) if len(values) >= FEW else None,
            )
        )  # fmt: skip
    return sorted(found, key=lambda figure: np.inf if figure.cpk is None else figure.cpk)


def repeat_command(row: Row, job: str, config: str) -> str:
    """The command that runs a world again, with the configuration and the calibration of its folder."""
    confirm = " --confirm simulated" if number(row.get("faults")) else ""
    return (
        f"cell dry-run -c {shlex.quote(config)} -j {shlex.quote(job)} --clock virtual --level {row['level']} "
        f"--seed {row['seed']}{confirm}"
    )


def _cycle(good: Sequence[Row]) -> CycleTime | None:
    times = [number(row.get("cycle_s")) for row in good]
    return CycleTime(len(times), float(np.mean(times)), float(np.percentile(times, 95))) if times else None


def _steps(good: Sequence[Row]) -> list[StepTime]:
    names = dict.fromkeys(name for row in good for name in row if re.fullmatch(r"step_\w+_s", name))
    means = {name: float(np.mean([number(row.get(name)) for row in good])) for name in names}
    whole = sum(means.values()) or 1.0
    found = [StepTime(name[len("step_") : -len("_s")], mean, mean / whole) for name, mean in means.items()]
    return sorted(found, key=lambda step: -step.mean_s)


def _reasons(rows: Sequence[Row]) -> list[WorldReason]:
    counted: Counter[tuple[str, str, str]] = Counter()
    first: dict[tuple[str, str, str], int] = {}
    for row in rows:
        if row["outcome"] not in GOOD:
            why = str(row["outcome"]), str(row["step"]), NUMBER.sub("…", str(row["reason"]))
            counted[why] += 1
            first.setdefault(why, int(number(row.get("seed"))))
    return [WorldReason(*why, count=count, seed=first[why]) for why, count in counted.most_common()]


def _worst(rows: Sequence[Row], figures: Sequence[FigureSpread], command: Callable[[Row], str]) -> list[WorstWorld]:
    """Each world that did not place, then the worst one of each of the figures that are nearest to their limits."""
    bad = [
        WorstWorld(int(number(row["seed"])), str(row["outcome"]), str(row["reason"]), "", None, command=command(row))
        for row in rows if row["outcome"] not in GOOD
    ]  # fmt: skip
    by_seed = {row["seed"]: row for row in rows}
    for figure in figures[:NEAREST]:
        row = by_seed[figure.worst_seed]
        if row["outcome"] in GOOD:
            told = figure.worst_seed, str(row["outcome"]), ""
            bad.append(WorstWorld(*told, figure.name, figure.worst_used, command=command(row)))
    return bad


FOLDER, SUFFIX = "qualified", ".qualified.json"


def line_file(job: str | Path, config: Path | None) -> Path:
    """Where the line of a job is: beside its file, or below the calibrations of a cell for a job that ships or whose
    folder cannot be written. `config` is the cell's file."""
    path, (_, number) = job_path(job), job_and_item(job)
    name = f"{path.stem}{'' if number is None else f'-{number}'}{SUFFIX}"
    if not ships(path) and os.access(path.parent, os.W_OK):
        return path.parent / name
    return beside(config) / load_config(config).cell.calibrations / FOLDER / name


def keep_line(answer: JobAnswer, job: str | Path, config: Path | None) -> Path:
    """Keep the line of an answer, with the hashes of what it is of; gives its file. Raises `OSError`."""
    file = line_file(job, config)
    file.parent.mkdir(parents=True, exist_ok=True)
    of = answer.of
    hashes = {"job_hash": of.job_hash, "configuration_hash": of.configuration_hash, "code_hash": of.code_hash}
    write_json(file, sealed({"line": answer.line, "job": of.job, **hashes}))
    return file


def kept_line(job: str | Path, config: Path | None) -> str | None:
    """The line of a job as it is now, or that it does not hold any more and why; None where nobody qualified it.
    `config` is the file that a command was given. Nothing is raised: what is wrong with the files is told elsewhere."""
    try:
        path = find_config(config, simulated=True)
        kept = read_json(line_file(job, path)).require()
        now = {"job": job_hash(job), "configuration": configuration_hash(load_config(path))}
    except (CellError, OSError, ValueError):
        return None
    changed = [name for name, value in now.items() if kept.get(f"{name}_hash") != value]
    if not changed:
        return str(kept.get("line"))
    verb = "has" if len(changed) == 1 else "have"
    return (
        f"{kept.get('line')}: that does not hold any more, {' and '.join(changed)} {verb} changed since; "
        f"`cell qualify {job}` tells anew"
    )


IDENTITY = ("job_hash", "configuration_hash", "code_hash")
ALWAYS = ("cycle_s", "true_error_max_mm", "stated_bound_mm")
"""Columns that are compared beside the figures."""


@dataclass(frozen=True)
class FigureDifference:
    """This campaign less the other: the mean of the paired differences, its 95 % interval, and of how many worlds."""

    name: str
    unit: str
    mean: float
    low: float | None
    high: float | None
    n: int


@dataclass(frozen=True)
class ChangedWorld:
    """A seed whose outcome changed, and why it is as it is now."""

    seed: int
    before: str
    now: str
    reason: str


@dataclass(frozen=True)
class PairedComparison:
    """`pairs` worlds of both campaigns; `other` names what differs there. `yields` is the difference in yield with the
    ends of its interval, as shares; differences are this campaign less the other."""

    other: Mapping[str, str]
    pairs: int
    yields: tuple[float, float, float]
    figures: Sequence[FigureDifference]
    changed: Sequence[ChangedWorld]


def other_rows(campaign: Campaign, folder: Path) -> list[Row]:
    """The rows in `folder` to compare with: of the same job and level, from the version that ran last. In the
    campaign's own folder that is another code, job or configuration. `ConfigError` where there is none."""
    if not (folder / ROWS).is_dir():
        raise ConfigError(f"--compare {folder}: it holds no campaign (there is no {folder / ROWS}); name its --out")
    rows = RowStore(folder).rows(job=campaign.of.job, level=campaign.level)
    if folder.resolve() == campaign.folder.resolve():
        own = campaign.wanted
        rows = [row for row in rows if any(row[name] != own[name] for name in IDENTITY)]
    if not rows:
        raise ConfigError(
            f"--compare {folder}: it holds no other worlds of job {campaign.of.job} at level {campaign.level}; run "
            "`cell qualify` with the other version first"
        )
    newest = max(rows, key=lambda row: number(row.get("ended_s")))
    return [row for row in rows if all(row[name] == newest[name] for name in IDENTITY)]


def compare(rows: Sequence[Row], others: Sequence[Row]) -> PairedComparison:
    """Pair by seed. `ConfigError` where no seed is in both."""
    before = {row["seed"]: row for row in others}
    pairs = [(row, before[row["seed"]]) for row in rows if row["seed"] in before]
    if not pairs:
        raise ConfigError("the two campaigns have no seed in common; give the same --first-seed, then compare again")
    good = [(now["outcome"] in GOOD, was["outcome"] in GOOD) for now, was in pairs]
    changed = [
        ChangedWorld(int(number(now["seed"])), str(was["outcome"]), str(now["outcome"]), str(now["reason"]))
        for now, was in pairs if now["outcome"] != was["outcome"]
    ]  # fmt: skip
    other = pairs[0][1]
    return PairedComparison(
        {name: str(other[name]) for name in IDENTITY}, len(pairs),
        share_difference(good.count((True, False)), good.count((False, True)), len(pairs)),
        figures=_differences(pairs), changed=changed,
    )  # fmt: skip


def _differences(pairs: Sequence[tuple[Row, Row]]) -> list[FigureDifference]:
    found = []
    for name in dict.fromkeys((*ALWAYS, *limited([now for now, _ in pairs]))):
        both = [number(now[name]) - number(was[name]) for now, was in pairs if name in now and name in was]
        if both:
            mean, low, high = mean_difference(both)
            found.append(FigureDifference(*shown(name), mean, low, high, n=len(both)))
    return found
