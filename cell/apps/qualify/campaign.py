"""A campaign: worlds in the order of their seeds, until enough is known. It goes on where it was stopped.

The answer is that of the first n seeds. n depends on their outcomes alone, not on how many workers there are.
"""

import re
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from cell.apps.qualify.identity import QualifiedCode, require_seeds
from cell.apps.qualify.intervals import Share
from cell.apps.qualify.rows import Row, RowStore, error_row
from cell.apps.qualify.workers import Workers
from cell.apps.qualify.world import WorldTask
from cell.run.batch import GOOD
from drivers.errors import ConfigError

LEAST, EVERY = 20, 10
"""The interval is looked at after so many worlds at first, and then after so many more."""
MOST = 2000
"""Worlds of a campaign that ends by its interval, unless told otherwise."""
DEATHS = 2
"""Of a worker in a world that it ran alone, after which that is the world's row."""
NARROWEST, WIDEST = 0.0005, 0.5


@dataclass(frozen=True)
class Target:
    """When a campaign ends: once the yield's interval has at most this half width, and after `most` worlds anyway."""

    most: int
    half_width: float | None = None

    @classmethod
    def of(cls, seeds: int | None, until: str | None, most: int | None) -> Self:
        """From what was typed. `ConfigError` for what is no target."""
        if seeds is not None:
            if until is not None or most is not None:
                raise ConfigError("--seeds excludes --until and --most; give a number of worlds, or an interval")
            return cls(seeds)
        text = "yield:±5%" if until is None else until
        found = re.fullmatch(r"yield:(?:±|\+-|\+/-)?(\d{1,3}(?:\.\d{1,4})?)\s*%", text.strip())
        width = float(found[1]) / 100.0 if found else 0.0
        if not NARROWEST <= width <= WIDEST:
            raise ConfigError(
                f"--until {text} is no target (allowed: yield:±{100 * NARROWEST:g}% to yield:±{100 * WIDEST:g}%); "
                "write for example --until yield:±1%"
            )
        return cls(MOST if most is None else most, width)


@dataclass(eq=False)
class Prefix:
    """The worlds of the first seeds, as far as all of them are there; `end` is how many answer, once that is known."""

    first: int
    target: Target
    known: int = 0
    good: int = 0
    end: int | None = None
    counts: Counter[str] = field(default_factory=Counter)
    _later: dict[int, str] = field(default_factory=dict)

    def take(self, seed: int, outcome: str) -> None:
        """Take the outcome of a world; those after the first that is missing wait for that."""
        if self.end is not None or not self.first + self.known <= seed < self.first + self.target.most:
            return
        self._later[seed] = outcome
        while self.end is None and (found := self._later.pop(self.first + self.known, None)) is not None:
            self.known += 1
            self.counts[found] += 1
            self.good += found in GOOD
            if self.known == self.target.most or self._narrow_enough():
                self.end = self.known

    def has(self, seed: int) -> bool:
        """Whether that world is there."""
        return seed < self.first + self.known or seed in self._later

    @property
    def yields(self) -> Share:
        """The share of good worlds."""
        return Share(self.good, self.known)

    @property
    def likely_end(self) -> int:
        """How many worlds will answer, if the yield stays as it is."""
        if self.end is not None or self.target.half_width is None:
            return self.end or self.target.most
        share = self.yields.share if self.known else 1.0
        counts = range(max(LEAST, self.known - self.known % EVERY), self.target.most, EVERY)
        enough = (n for n in counts if Share(share * n, n).half_width <= self.target.half_width)
        return next(enough, self.target.most)

    def _narrow_enough(self) -> bool:
        width = self.target.half_width
        if width is None or self.known < LEAST or self.known % EVERY:
            return False
        return self.yields.half_width <= width


@dataclass(frozen=True)
class Campaign:
    """The worlds of one level from seed `first` on, for the job in file `job` under the text of a `configuration`."""

    of: QualifiedCode
    job: str
    configuration: str
    folder: Path
    level: str
    first: int
    target: Target

    def __post_init__(self) -> None:
        require_seeds(self.first, self.target.most)

    @property
    def wanted(self) -> dict[str, str]:
        """The columns of this campaign's rows, whatever other rows the folder has."""
        of = self.of
        return {
            "job": of.job, "job_hash": of.job_hash, "configuration_hash": of.configuration_hash,
            "code_hash": of.code_hash, "level": self.level, "schedule": "",
        }  # fmt: skip

    def known(self, store: RowStore) -> Prefix:
        """What is there of it already."""
        prefix = Prefix(self.first, self.target)
        for seed, outcome in sorted(store.outcomes(**self.wanted).items()):
            prefix.take(seed, outcome)
        return prefix

    def rows(self, store: RowStore, count: int) -> list[Row]:
        """The rows of the first `count` seeds, in their order."""
        seeds = range(self.first, self.first + count)
        found = {int(row["seed"] or 0): row for row in store.rows(**self.wanted)}
        return [found[seed] for seed in seeds if seed in found]

    def run(self, store: RowStore, opened: Callable[[], Workers], shown: Callable[[Prefix], None]) -> Prefix:
        """Run what is missing, keeping each row as it ends; `shown` is told after each. Workers are ended at the end.
        Raises `CellError` where workers cannot go on; the rows that came are kept then, as after an interrupt."""
        with store.writing():
            prefix = self.known(store)
            shown(prefix)
            if prefix.end is None:
                workers = opened()
                try:
                    self._run(store, workers, prefix, shown)
                finally:
                    workers.close()
            return prefix

    def _run(self, store: RowStore, workers: Workers, prefix: Prefix, shown: Callable[[Prefix], None]) -> None:
        missing, again, died = self._missing(prefix), deque[WorldTask](), Counter[str]()
        begun = 0
        while prefix.end is None:
            # Tried again alone: it is not to blame for another world that kills its worker.
            alone = bool(again) and begun == 0
            room = 1 if alone else 0 if again else workers.room
            while begun < room and (task := again.popleft() if again else next(missing, None)) is not None:
                workers.begin(task)
                begun += 1
            for task, row in workers.ended():
                begun -= 1
                died[task.key] += row is None and alone
                if row is None and died[task.key] < DEATHS:
                    again.append(task)
                    continue
                row = row or self._died(task)
                store.append(row)
                prefix.take(task.seed, str(row["outcome"]))
                shown(prefix)

    def _missing(self, prefix: Prefix) -> Iterator[WorldTask]:
        for seed in range(self.first, self.first + self.target.most):
            if not prefix.has(seed):
                yield self.task(seed)

    def task(self, seed: int) -> WorldTask:
        """The world of a seed."""
        return WorldTask(self.of, self.job, self.configuration, self.folder, level=self.level, seed=seed)

    def _died(self, task: WorldTask) -> Row:
        reason = f"the worker process died in this world, alone, {DEATHS} times"
        return error_row(self.of, self.level, task.seed, outcome="error", step="", code="WorkerDied", reason=reason)
