"""`cell qualify` as it is typed, with worlds that cost nothing."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.apps.qualify import workers
from cell.apps.qualify.workers import Ended
from cell.apps.qualify.world import WorldTask
from tests.support import Typed
from tests.support.qualified import row

pytest.importorskip("pyarrow")


class Quick:
    """Runs worlds in this process; `ends_at` is a seed at which Ctrl-C is pressed."""

    room, ends_at, error_mm, outcome = 1, 0, 0.1, "placed"

    def begin(self, task: WorldTask) -> None:
        self.task = task

    def ended(self) -> Iterator[Ended]:
        if self.task.seed == self.ends_at:
            raise KeyboardInterrupt
        yield self.task, row(self.task.seed, self.outcome, self.error_mm, of=self.task.of)

    def close(self) -> None:
        pass


@pytest.fixture
def quick(here: Path, monkeypatch) -> Quick:
    made = Quick()
    monkeypatch.setattr(workers, "open_workers", lambda *_: made)
    monkeypatch.setattr("cell.apps.qualify.page.plots_of", lambda *_: [])
    return made


def test_it_prints_the_answer_and_leaves_page_rows_and_line(quick: Quick, here: Path, typed: Typed):
    code, out, _ = typed("qualify", "pot", "--seeds", "6")
    assert code == 0
    for words in ("how 6 worlds of nominal ended", "[54.1, 100.0] %", "place error, largest", "≤ 0.6", "cycle time"):
        assert words in out
    assert "cell dry-run -c qualify/pot/worlds/" in out
    assert (here / "qualify" / "pot" / "qualify.html").is_file()
    assert (here / "calibrations" / "qualified" / "pot.qualified.json").is_file()


def test_more_seeds_are_added_and_json_says_the_same(quick: Quick, here: Path, typed: Typed):
    typed("qualify", "pot", "--seeds", "6")
    code, out, _ = typed("qualify", "pot", "--seeds", "10", "--json")
    told = json.loads(out)
    assert (code, told["worlds"], told["shares"]["placed"]["count"]) == (0, 10, 10)
    assert told["line"].endswith("10 worlds of nominal, yield 100.0 % [69.2, 100.0]")


def test_ctrl_c_keeps_the_rows(quick: Quick, here: Path, typed: Typed):
    quick.ends_at = 4
    code, out, complaints = typed("qualify", "pot", "--seeds", "6")
    assert (code, out) == (130, "")
    assert "interrupted: 3 worlds are kept in qualify/pot; the same command goes on" in complaints


@pytest.mark.parametrize(
    ("outcome", "error_mm", "code", "unnoticed"), [("refused", 0.1, 0, 0), ("error", 0.1, 1, 0), ("placed", 0.7, 1, 2)]
)
def test_an_error_and_a_part_that_nobody_noticed_outside_its_tolerance_fail(
    quick: Quick, typed: Typed, outcome: str, error_mm: float, code: int, unnoticed: int
):
    quick.outcome, quick.error_mm = outcome, error_mm
    ended, out, _ = typed("qualify", "--seeds", "2", "--json")
    assert (ended, json.loads(out)["unnoticed"]["count"]) == (code, unnoticed)


def test_campaigns_are_compared(quick: Quick, here: Path, typed: Typed):
    typed("qualify", "--seeds", "3", "--out", "before")
    quick.error_mm = 0.2
    code, out, _ = typed("qualify", "--seeds", "4", "--compare", "before", "--json")
    told = json.loads(out)["compared"]
    assert (code, told["pairs"], told["yields"][0], told["changed"]) == (0, 3, 0.0, [])
    assert {one["name"]: round(one["mean"], 3) for one in told["figures"]}["true error max"] == 0.1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--seeds", "0"), "allowed: 1 or more"),
        (("--seeds", "5", "--first-seed", "999998"), "allowed: 0 to 999999"),
        (("--until", "yield:±60%"), "allowed: yield:±0.05% to yield:±50%"),
        (("--seeds", "5", "--most", "7"), "--seeds excludes --until and --most"),
        (("--compare", "nothing"), "it holds no campaign"),
        (("--level", "calm"), "nominal"),
        (("nothing",), "neither a file"),
    ],
)
def test_what_cannot_be_is_told(quick: Quick, typed: Typed, words: tuple[str, ...], told: str):
    code, out, complaints = typed("qualify", *words)
    assert (code, out) == (2, "")
    assert told in complaints
