"""The course of a campaign: what is missing, when it ends, what becomes of a worker's death."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.apps.qualify.campaign import Prefix, Target
from cell.apps.qualify.identity import QualifiedCode
from cell.apps.qualify.intervals import Share
from cell.apps.qualify.rows import RowStore
from cell.apps.qualify.workers import Ended
from cell.apps.qualify.world import WorldTask
from drivers.errors import CellError, ConfigError
from tests.support.qualified import OF, campaign, quick

pytest.importorskip("pyarrow")


class Here:
    """Runs worlds in this process, mostly the newest first; `dies` names how often a seed's worker dies."""

    def __init__(self, room: int = 1, dies: dict[int, int] | None = None) -> None:
        self.room = room
        self.dies = dies or {}
        self.begun: list[int] = []
        self.alone: list[int] = []
        self.closed = False
        self._waiting: list[WorldTask] = []

    def begin(self, task: WorldTask) -> None:
        if task.seed in self.begun and not self._waiting:
            self.alone.append(task.seed)
        self.begun.append(task.seed)
        self._waiting.append(task)
        assert len(self._waiting) <= self.room

    def ended(self) -> Iterator[Ended]:
        task = self._waiting.pop(0 if len(self.begun) % 3 == 0 else -1)
        if self.dies.get(task.seed, 0) > 0:
            self.dies[task.seed] -= 1
            yield task, None
            return
        yield task, quick(task)

    def close(self) -> None:
        self.closed = True


def run(folder: Path, target: Target, workers: Here, first: int = 1, of: QualifiedCode = OF) -> Prefix:
    return campaign(folder, target, first, of).run(RowStore(folder), lambda: workers, lambda prefix: None)


def test_a_campaign_runs_what_is_missing_only(tmp_path):
    first = Here()
    assert run(tmp_path, Target(5), first).end == 5
    assert (first.begun, first.closed) == ([1, 2, 3, 4, 5], True)
    more = Here()
    run(tmp_path, Target(8), more)
    assert more.begun == [6, 7, 8]
    none = Here()
    assert run(tmp_path, Target(8), none).end == 8
    assert none.begun == []


@pytest.mark.parametrize("error", [KeyboardInterrupt(), CellError("the scheduler is gone")], ids=["Ctrl-C", "lost"])
def test_one_that_was_interrupted_or_lost_its_workers_goes_on(tmp_path, error: BaseException):
    class Ends(Here):
        def ended(self) -> Iterator[Ended]:
            if len(self.begun) == 4:
                raise error
            return super().ended()

    stopped = Ends()
    with pytest.raises(type(error)):
        run(tmp_path, Target(6), stopped)
    assert stopped.closed and len(RowStore(tmp_path).rows()) == 3
    again = Here()
    assert run(tmp_path, Target(6), again).known == 6
    assert again.begun == [4, 5, 6]


def test_rows_of_other_code_are_not_mixed_in(tmp_path):
    run(tmp_path, Target(3), Here())
    newer, workers = QualifiedCode("pot", OF.job_hash, OF.configuration_hash, "code2"), Here()
    run(tmp_path, Target(2), workers, of=newer)
    assert workers.begun == [1, 2]
    store = RowStore(tmp_path)
    assert len(store.rows()) == 5
    rows = campaign(tmp_path, Target(2), of=newer).rows(store, 2)
    assert [one["code_hash"] for one in rows] == ["code2"] * 2


@pytest.mark.parametrize("room", [1, 2, 7])
def test_until_ends_at_the_same_seed_whatever_the_workers(tmp_path, room: int):
    # Nine of ten are good; by the first seeds alone the interval is narrow enough at a multiple of ten.
    target = Target(500, 0.09)
    prefix = run(tmp_path, target, Here(room))
    wanted = next(n for n in range(20, 500, 10) if Share(n - n // 10, n).half_width <= 0.09)
    assert (prefix.end, prefix.good) == (wanted, wanted - wanted // 10)
    rows = campaign(tmp_path, target).rows(RowStore(tmp_path), wanted)
    assert [one["seed"] for one in rows] == list(range(1, wanted + 1))


def test_a_prefix_waits_for_its_first_seeds():
    prefix = Prefix(1, Target(3))
    for seed in (3, 2, 5, 0):
        prefix.take(seed, "placed")
    assert (prefix.known, prefix.end) == (0, None)
    assert prefix.has(3) and not prefix.has(1)
    prefix.take(1, "refused")
    assert (prefix.known, prefix.good, prefix.end) == (3, 2, 3)


def test_a_worker_that_dies_is_tried_again_and_then_is_a_row(tmp_path):
    # By others that kill it a worker may die once with a world that then dies once by itself: no reason to give it up.
    workers = Here(2, dies={2: 2, 3: 3})
    run(tmp_path, Target(4), workers)
    assert (workers.begun.count(2), workers.begun.count(3)) == (3, 3)
    assert sorted(workers.alone) == [2, 2, 3, 3], "whose worker died is tried again with nothing beside it"
    rows = {one["seed"]: one for one in RowStore(tmp_path).rows()}
    assert [rows[seed]["outcome"] for seed in (1, 2, 3, 4)] == ["placed", "placed", "error", "placed"]
    assert rows[3]["code"] == "WorkerDied"


def test_targets_from_the_command_line():
    assert (Target.of(None, None, None), Target.of(7, None, None)) == (Target(2000, 0.05), Target(7))
    for text in ("yield:±1%", "yield:1 %", "yield:+-1%"):
        assert Target.of(None, text, 300) == Target(300, 0.01)
    for text in ("yield", "yield:±0%", "yield:±80%", "cpk:±1%"):
        with pytest.raises(ConfigError, match=r"allowed: yield:±0.05% to yield:±50%"):
            Target.of(None, text, None)
    with pytest.raises(ConfigError, match="excludes"):
        Target.of(7, None, 300)


def test_how_many_worlds_are_likely():
    prefix = Prefix(1, Target(2000, 0.01))
    assert prefix.likely_end == next(n for n in range(20, 2000, 10) if Share(n, n).half_width <= 0.01)
    assert Prefix(1, Target(7)).likely_end == 7
