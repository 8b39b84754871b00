"""What rows say: shares, figures beside their limits, reasons, the worst worlds and the commands that repeat them."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from cell.apps.qualify.answer import JobAnswer, compare, keep_line, kept_line, line_file, other_rows, repeat_command
from cell.apps.qualify.campaign import Target
from cell.apps.qualify.identity import QualifiedCode
from cell.apps.qualify.rows import Row, RowStore
from cell.config.cell_config import default_toml, load_config
from cell.config.job import job_path
from drivers.errors import ConfigError
from tests.support import Typed
from tests.support.qualified import COVERED, ERROR, OF, campaign, row


def answer(*rows: Row) -> JobAnswer:
    return JobAnswer.of_rows(
        OF, "nominal", first=1, rows=rows, command=lambda one: f"repeat {one['seed']}", date="2026-11-30"
    )


def some() -> JobAnswer:
    return answer(
        *(row(seed, error_mm=0.05 * seed, corrections=int(seed == 4)) for seed in range(1, 7)),
        row(7, "refused", step="invert_pose", reason="the fit is 0.31 mm off, allowed are 0.3 mm"),
        row(8, "refused", step="invert_pose", reason="the fit is 0.42 mm off, allowed are 0.3 mm"),
        row(9, "error", code="KeyError", reason="KeyError: 'x'"), row(10, "misplaced", reason="it lies askew"),
    )  # fmt: skip


def test_shares_count_how_worlds_ended():
    counts = {name: share.count for name, share in some().shares.items()}
    assert counts == {"placed": 6, "corrected": 1, "refused": 2, "misplaced": 1, "faulted": 0, "error": 1}
    assert some().yields.of == 10
    assert some().line == "qualified 2026-11-30, 10 worlds of nominal, yield 60.0 % [26.2, 87.8]"


def test_a_figure_lies_beside_its_limit():
    told = {figure.name: figure for figure in some().figures}
    figure = told["place error, largest of 45 points"]
    assert (figure.unit, figure.bound, figure.limit, figure.n) == ("mm", "at most", 0.6, 6)
    assert (figure.mean, figure.worst, figure.worst_seed) == pytest.approx((0.175, 0.3, 6))
    assert figure.worst_used == pytest.approx(0.5)
    # By hand: the values are 0.05 to 0.30 by 0.05, whose σ is 0.0935.
    assert figure.cpk == pytest.approx((0.6 - 0.175) / (3 * 0.09354), rel=1e-3)
    covered = told["surface covered"]
    assert (covered.bound, covered.worst, covered.worst_seed) == ("at least", 89.0, 6)


def test_parts_outside_the_tolerance_that_nobody_noticed_are_counted():
    assert some().unnoticed.count == 0
    out = answer(row(1), row(2, error_mm=0.61), row(3, "misplaced", true_error_max_mm=0.9))
    assert (out.unnoticed.count, out.unnoticed.of) == (1, 2)


def test_the_stated_bounds_are_held_against_the_truth():
    covered = answer(row(1, points_covered=1.0), row(2, points_covered=0.8), row(3, "refused")).covered
    assert (covered.count, covered.of) == pytest.approx((1.8, 2))
    assert answer(row(3, "refused")).covered is None


def test_reasons_are_counted_without_their_numbers():
    first, *others = some().reasons
    assert (first.outcome, first.step, first.count, first.seed) == ("refused", "invert_pose", 2, 7)
    assert first.reason == "the fit is … mm off, allowed are … mm"
    assert [one.outcome for one in others] == ["error", "misplaced"]


def test_the_worst_worlds_are_those_that_failed_then_those_nearest_a_limit():
    worst = some().worst
    assert [world.seed for world in worst] == [7, 8, 9, 10, 6, 6]
    assert worst[0].command == "repeat 7"
    assert worst[4].figure in (ERROR.partition(" [")[0], COVERED.partition(" [")[0])


def test_times_are_of_good_worlds():
    told = some()
    assert (told.cycle.n, told.cycle.mean_s) == (6, pytest.approx(53.5))
    assert [(step.name, round(step.share, 3)) for step in told.steps] == [("place", 0.667), ("laser_sweep", 0.333)]


def test_a_world_is_repeated_by_a_command():
    told = repeat_command(row(7), "my job.toml", "qualify/w/cell.toml")
    wanted = "cell dry-run -c qualify/w/cell.toml -j 'my job.toml' --clock virtual --level nominal --seed 7"
    assert told == wanted
    assert repeat_command(row(7, faults=1), "pot", "c").endswith("--confirm simulated")


def test_it_is_json():
    told = json.loads(json.dumps(some().as_dict(), allow_nan=False))
    assert told["shares"]["placed"].items() >= {"count": 6, "of": 10, "share": 0.6}.items()
    assert json.dumps(answer(row(1, "refused")).as_dict(), allow_nan=False)


LINE = "qualified 2026-11-30, 1 world of nominal, yield 100.0 % [2.5, 100.0]"


@pytest.fixture
def own(here: Path) -> Path:
    """The job `pot` and the configuration that ship, as files of the present folder."""
    shipped = job_path("pot")
    (here / "pot.ply").write_bytes((shipped.parent / "pot.ply").read_bytes())
    (here / "pot.toml").write_text(shipped.read_text(encoding="utf-8"), encoding="utf-8")
    (here / "cell.toml").write_text(default_toml(), encoding="utf-8")
    return here


def keep(job: str, config: Path | None) -> Path:
    of = QualifiedCode.of(job, load_config(config))
    told = JobAnswer.of_rows(of, "nominal", first=1, rows=[row(1)], command=lambda one: "", date="2026-11-30")
    return keep_line(told, job, config)


def test_a_line_holds_until_job_or_configuration_change(own: Path):
    assert kept_line("pot", None) is None
    assert keep("pot", Path("cell.toml")) == Path("pot.qualified.json")
    assert kept_line("pot", None) == LINE
    text = (own / "cell.toml").read_text(encoding="utf-8")
    (own / "cell.toml").write_text("# a comment\n" + text, encoding="utf-8")
    assert kept_line("pot", None) == LINE
    (own / "pot.toml").write_text((own / "pot.toml").read_text(encoding="utf-8") + "\n", encoding="utf-8")
    told = kept_line("pot", None)
    assert told == f"{LINE}: that does not hold any more, job has changed since; `cell qualify pot` tells anew"
    changed = text.replace('name = "cell-1"', 'name = "cell-2"')
    assert changed != text
    (own / "cell.toml").write_text(changed, encoding="utf-8")
    assert "job and configuration have changed" in str(kept_line("pot", None))


def test_that_of_a_job_that_ships_lies_below_the_calibrations(here: Path):
    assert line_file("tray4#2", None) == here / "calibrations" / "qualified" / "tray4-2.qualified.json"
    assert keep("pot", None) == here / "calibrations" / "qualified" / "pot.qualified.json"
    assert kept_line("pot", None) == LINE


def test_what_cannot_be_read_is_left_out(own: Path):
    file = keep("pot", Path("cell.toml"))
    file.write_text(file.read_text(encoding="utf-8").replace("100.0 %", "99.9 %"), encoding="utf-8")
    assert kept_line("pot", None) is None, "a line that was edited is none"
    assert kept_line("nothing", None) is None


def test_a_command_that_runs_the_job_shows_it(own: Path, typed: Typed):
    keep("pot", Path("cell.toml"))
    _, _, complaints = typed("dry-run", "--inject", "arm.nothing@place:1%")
    assert LINE not in complaints, "nothing is told before the command is right"
    _, _, complaints = typed("dry-run", "--clock", "virtual", "--speed", "2")
    assert LINE in complaints


pytest.importorskip("pyarrow")
OLD = replace(OF, code_hash="old")


def test_pairs_are_of_the_same_seed():
    now = [row(1, error_mm=0.1), row(2, error_mm=0.2), row(3, "refused", reason="dark"), row(9)]
    before = [row(3, of=OLD), row(2, error_mm=0.3, of=OLD), row(1, error_mm=0.2, of=OLD), row(8, of=OLD)]
    told = compare(now, before)
    assert (told.pairs, told.other["code_hash"]) == (3, "old")
    assert told.yields[0] == pytest.approx(-1 / 3)
    assert [(one.seed, one.before, one.now, one.reason) for one in told.changed] == [(3, "placed", "refused", "dark")]
    figure = next(one for one in told.figures if one.name == "place error, largest of 45 points")
    assert (figure.mean, figure.n) == (pytest.approx(-0.1), 2)
    with pytest.raises(ConfigError, match="no seed in common"):
        compare([row(1)], [row(2)])


def test_in_one_folder_it_is_the_other_version_that_ran_last(tmp_path):
    store, older = RowStore(tmp_path), replace(OF, code_hash="older")
    for one in (row(1), row(1, of=OLD, ended_s=2e9), row(2, of=OLD, ended_s=3e9), row(1, of=older, ended_s=1e9)):
        store.append(one)
    found = other_rows(campaign(tmp_path, Target(2)), tmp_path)
    assert {one["code_hash"] for one in found} == {"old"}
    assert len(found) == 2


def test_where_there_is_nothing_to_compare_with_that_is_told(tmp_path):
    with pytest.raises(ConfigError, match="holds no campaign"):
        other_rows(campaign(tmp_path, Target(2)), tmp_path)
    RowStore(tmp_path).append(row(1))
    with pytest.raises(ConfigError, match="no other worlds"):
        other_rows(campaign(tmp_path, Target(2)), tmp_path)
    assert len(other_rows(campaign(tmp_path / "other", Target(2)), tmp_path)) == 1
