"""A batch on the virtual clock: its figures are those of its runs, and what ends it leaves what was done whole."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell import Cell, ConfigError
from cell.base.storage import read_json
from cell.config.job import job_path, load_job
from cell.devices.simulated.described import Described
from cell.procedures.steps.workplace import PartsBefore
from cell.run.batch import _known_after, _question, perform
from cell.run.folder import list_runs, read_report
from cell.run.job_run import RunOutcome
from cell.run.recorded_work import WorkContext
from lab.bench.job.part_effects import held, motion
from lab.bench.job.part_jobs import MIDDLE, job_with_part
from lab.bench.job.whole_job import JobRecord
from statemachine.control import RunControl
from statemachine.journal import request
from statemachine.step import Event
from tests.support import Typed
from tests.support.described_cells import LEAN, Changes, described, pose, quick

FAST: Changes = {"scan": {"speed": '"30 mm/s"', "frame_rate": '"15 Hz"'}}


@pytest.fixture
def opened(calibrated_folder: Path) -> Callable[..., Cell]:
    """Opens a calibrated cell with the job `own.toml` that has these rules; `moved`: its scan head was bumped since."""

    def make(on_refusal: str = "", moved: bool = False) -> Cell:
        config, own = described(calibrated_folder, LEAN, FAST)
        if on_refusal:
            own.write_text(f'{own.read_text()}\n[batch]\non_refusal = "{on_refusal}"\n')
        head: Changes = {"scan_camera": {"flange_from_camera": pose((92, -50, 80), (0, 0, 90))}}
        true = described(calibrated_folder / "true", head)[0] if moved else None
        return Cell.open(config, sim="all", clock="virtual", seed=2, job=own, truth=true)

    return make


def test_the_figures_are_those_of_the_runs_and_what_the_parts_have_alike_is_allowed_for(
    opened: Callable[..., Cell], tmp_path
):
    """Each part is gripped otherwise, and lies .3 mm aside in the claw."""
    lines: list[str] = []
    file = job_with_part(tmp_path, "pot", verify="all", half=MIDDLE)
    file.write_text(quick(file.read_text(), rate=25.0))
    aside = held(motion(0.0, 0.3))
    with opened() as cell:
        world = cell.simulated.world

        def observe(event: Event) -> None:
            lines.append(str(event.data.get("text")))
            if (event.kind, event.step) == ("step_started", "drive_to_target"):
                aside(world)

        batch = cell.run_batch("pot.toml", 3, observe)
    steps = [{step["name"]: step["result"] for step in run.report["steps"]} for run in batch.runs]
    # The arm goes to the deck once, and stays at the station until the last part.
    assert ["interim" in each["drive_to_target"] for each in steps] == [True, False, False]
    assert ["head_looked_s_ago" in each["laser_sweep"] for each in steps] == [False, True, True]
    assert [each["drive_to_target"]["photographs"] for each in steps[1:]] == [1, 1]
    assert batch.runs[1].report["cell_s"] < batch.runs[0].report["cell_s"] - 15.0
    assert ["allowed_for" in each["place"] for each in steps] == [False, False, True]
    assert steps[2]["place"]["allowed_for"]["shift_mm"] == [pytest.approx(0.0, abs=0.15), pytest.approx(0.3, abs=0.15)]
    for each in steps:
        assert each["verify"]["came_mm"] == [pytest.approx(0.0, abs=0.15), pytest.approx(0.3, abs=0.15)]
    assert (batch.exit_code, batch.counts["placed"], batch.counts["not tried"]) == (0, 3, 0)
    assert steps[2]["verify"]["off_mm"] < 0.5 * min(each["verify"]["off_mm"] for each in steps[:2])
    assert read_json(batch.file).require() == json.loads(json.dumps(batch.as_dict()))
    reports = [read_report(run.folder) for run in batch.runs]
    assert len({json.dumps(report["truth"]["error_mm"]) for report in reports}) == 3
    seen = [each["verify"] for each in steps]
    series = {
        "cycle time": [report["cell_s"] for report in reports],
        "placed part off its place at first": [[*each["before_mm"], each["off_mm"]][0] for each in seen],
        "placed part off its place, as seen": [each["off_mm"] for each in seen],
        "corrections": [len(each["before_mm"]) for each in seen],
        "gap, median": [each["gap"]["median_mm"] for each in seen],
    }
    for row in reports[0]["measured"]:
        series[row["name"]] = [next(r["value"] for r in x["measured"] if r["name"] == row["name"]) for x in reports]
    assert [figure.name for figure in batch.figures] == list(series)
    for figure in batch.figures:
        values = np.array(series[figure.name])
        expected = [values.mean(), values.std(ddof=1), values.min(), values.max()]
        assert figure.n == 3
        np.testing.assert_allclose([figure.mean, figure.sd, figure.min, figure.max], expected, rtol=1e-9, atol=1e-12)
    assert [line for line in lines if line.startswith("part 3 of 3  placed: ") and line.endswith("3 placed")]


@pytest.mark.parametrize(("rule", "refused"), [("", 1), ("skip", 2)])
def test_after_a_refusal_the_job_decides(opened: Callable[..., Cell], rule: str, refused: int):
    with opened(rule, moved=True) as cell:
        assert load_job("own.toml")[0].batch.on_refusal == (rule or "end")
        batch = cell.run_batch("own.toml", 2)
    assert (batch.counts["refused"], batch.counts["not tried"], batch.exit_code) == (refused, 2 - refused, 1)
    assert batch.figures == ()


def test_where_the_job_asks_a_person_goes_on_or_ends_it(opened: Callable[..., Cell]):
    """The second question is answered with the end; nothing is tried before the first is answered."""
    asked: list[str] = []
    with opened("ask", moved=True) as cell:

        def answer(event: Event) -> None:
            if event.kind == "confirm_needed" and cell.current is not None:
                asked.append(str(event.data["reason"]))
                assert len(list(cell.runs_folder.glob("*/journal.sqlite"))) == 2 * len(asked)
                if len(asked) == 1:
                    cell.current.confirm("Ann")
                else:
                    cell.current.abort("Ann ends it")

        batch = cell.run_batch("own.toml", 3, answer)
    assert (batch.counts["refused"], batch.counts["not tried"], batch.exit_code) == (2, 1, 1)
    assert [text.rpartition(". ")[2] for text in asked] == ["Go on with part 2 of 3?", "Go on with part 3 of 3?"]
    assert "after part 2: loading ended: Ann ends it" in batch.reason


def test_an_abort_in_the_second_part_leaves_the_first_whole_and_tells_what_was_not_tried(opened: Callable[..., Cell]):
    before: list[dict[str, Any]] = []
    with opened() as cell:

        def end(event: Event) -> None:
            files = list(cell.runs_folder.glob("batch-*.json"))
            if files and event.kind == "step_started" and event.step == "board_photo" and cell.current is not None:
                before.append(read_json(files[0]).require())
                cell.current.abort("seen enough")

        batch = cell.run_batch("own.toml", 3, end)
    assert before[0]["reason"] == "not ended, or its process died"
    assert before[0]["counts"] == {**batch.counts, "aborted": 0, "not tried": 2}
    assert [run.outcome for run in batch.runs] == ["placed", "aborted"]
    assert (batch.reason, batch.counts["not tried"], batch.exit_code) == ("part 2 aborted: seen enough", 1, 1)
    assert read_report(batch.runs[0].folder)["outcome"] == "placed"


def test_somebody_lets_this_part_be_the_last(opened: Callable[..., Cell]):
    """One that is refused by a job that goes on after refusals: none takes less time."""
    with opened("skip", moved=True) as cell:

        def ask(event: Event) -> None:
            if (event.kind, event.step) == ("step_started", "drive_to_target"):
                request(list_runs(cell.runs_folder)[-1], "end-batch", "home time")

        batch = cell.run_batch("own.toml", 2, ask)
    assert ([run.outcome for run in batch.runs], batch.reason) == (["refused"], "after part 1, as asked")


@pytest.mark.parametrize(("name", "shares"), [("swap", True), ("two-stations", False)])
def test_items_are_made_ready_once_a_round_and_those_not_tried_are_named(
    opened: Callable[..., Cell], tmp_path, placed_pot: JobRecord, name: str, shares: bool
):
    jobs, asked, tried = [load_job(f"{name}#{k}")[0] for k in (1, 2)], list[int](), list[int]()
    shared, known = list[bool](), list[tuple[bool, ...]]()

    def run(number: int, before: PartsBefore) -> RunOutcome:
        known.append((before.look is not None, before.board is not None, before.touch_off is not None, before.more))
        tried.append(number)
        shared.append(before.arrival is not None and before.arrival.shared is placed_pot.results["board_photo"])
        how = ("placed", "in place") if number < 4 else ("aborted", "seen enough")
        return RunOutcome(*how, tmp_path, {"cell_s": 1.0, "measured": [], "steps": []}, placed_pot.results)

    with opened() as cell:
        open_cell = replace(cell._open_cell, simulated=None)
        cell.runs_folder.mkdir()
        batch = perform(open_cell, jobs, 3, run, between=lambda work: asked.append(len(tried)), observer=None)
    assert (tried, asked) == ([1, 2, 3, 4], [2]), "a person at a real cell makes both items ready again"
    assert shared == [False, shares, False, shares], "before another stop the vehicle does not stand yet"
    assert [more for *_, more in known] == [True, False, True, False], "a person makes the third ready"
    assert [look for look, *_ in known] == [False, True, False, True], "who was there may have bumped the head"
    assert [touch for *_, touch, _ in known] == [False, True, True, True]
    assert [board for _, board, *_ in known[1:]] == [shares, False, shares], "nor is the station where it was"
    assert (batch.job, batch.count) == (name, 6)
    assert batch.reason == f"part 4 aborted: seen enough; not tried: {name}#1, {name}#2"


@pytest.mark.parametrize(("faults", "held"), [([], False), ([{"code": "arm.protective_stop"}], False), ([], True)])
def test_no_part_goes_by_a_look_at_the_head_from_before_a_fault_or_a_hold(
    placed_pot: JobRecord, tmp_path, faults: list[dict[str, str]], held: bool
):
    control = RunControl()
    if held:
        control.pause()
        control.safe_point(control.token, lambda stays: control.go_on() if stays else None)
    report = {"cell_s": 1.0, "measured": [], "steps": [], "faults": faults}
    last = RunOutcome("placed", "in place", tmp_path, report, placed_pot.results, control)
    known = _known_after(PartsBefore(), last, each_job=True)
    assert (known.look is not None) == (not faults and not held)
    # Who held it may have pushed it.
    assert (known.board is not None, known.arrival is not None) == (not held, not held)
    sweep = placed_pot.results["laser_sweep"]
    if known.look is not None:
        assert (known.look.at, known.look.pointing) == (sweep.times[0], sweep.pointing)
        # One that went by an earlier look hands that on, as old as it is.
        shared = {**placed_pot.results, "laser_sweep": replace(sweep, looked_s=30.0)}
        assert _known_after(known, replace(last, results=shared), each_job=True).look is known.look
        # One whose fine board nobody saw is none.
        unseen = {**placed_pot.results, "drive_to_target": replace(placed_pot.results["drive_to_target"], head=None)}
        assert _known_after(known, replace(last, results=unseen), each_job=True).look is None
        assert _known_after(known, replace(last, results=unseen), each_job=False).look is not None


def test_a_count_out_of_range_is_told_with_the_range(opened: Callable[..., Cell], typed: Typed):
    with opened() as cell:
        for count in (0, 10_001):
            with pytest.raises(ConfigError, match="allowed: 1 to 10000"):
                cell.run_batch("own.toml", count)
    code, _, error = typed("dry-run", "-j", "own.toml", "--count", "0")
    assert (code, "allowed: 1 to 10000" in error) == (2, True), error


def test_the_claw_closes_and_the_arm_moves_only_after_a_word_each(opened: Callable[..., Cell], tmp_path):
    """As at a cell with real devices: the person holds a part between the fingers at the second question only."""
    asked: list[str] = []
    with opened() as cell:
        job, last = load_job("own.toml")[0], RunOutcome("placed", "all steps done", tmp_path, {})
        open_cell, claw = replace(cell._open_cell, simulated=None), cell.devices.claw

        def person(what: str) -> None:
            asked.append(what.split()[0])
            assert claw.holding == cell.simulated.world.switched("claw") == (asked[-1] == "The")
            if asked == ["Hold", "Hold"]:
                cell.simulated.make_ready(Described.of("own.toml"))

        def work(context: WorkContext) -> None:
            with cell.maintenance("the part is taken out", ["claw_at_contact"]):
                claw.release()
            assert _question(open_cell, job, "part 2 of 2", last, refill=False) is None
            question = _question(open_cell, job, "part 2 of 2", last, refill=True)
            question(replace(context, ask=person))

        cell.perform("loading", work)
    assert asked == ["Hold", "Hold", "The"]
    assert _question(cell._open_cell, job, "part 2 of 2", last, refill=True) is None


def test_a_fault_ends_it_whatever_the_job_says_of_refusals_and_the_command_line_shows_it(
    opened: Callable[..., Cell], typed: Typed
):
    opened("skip").close()
    words = ("dry-run", "-c", "cell.toml", "-j", "own.toml", "--clock", "virtual", "--seed", "2", "--count", "2")
    code, out, error = typed(*words, "--inject", "arm.emergency_stop@drive_to_target:40%")
    shown = ("0 placed, 0 corrected" in out, "1 faulted" in out, "part 1 of 2  faulted" in error)
    assert (code, shown) == (1, (True, True, True)), (out, error)
    (file,) = Path("runs").glob("batch-*.json")
    told = read_json(file).require()
    assert (told["counts"]["faulted"], told["counts"]["not tried"]) == (1, 1)
    assert told["reason"].startswith("part 1 faulted: ")
    assert typed(*words, "--until", "board_photo")[0] == 2


def test_a_dry_run_that_would_ask_where_nobody_is_is_refused(here: Path, typed: Typed):
    """No terminal is here: the batch would wait for ever."""
    (here / "pot.ply").write_bytes(job_path("pot").with_suffix(".ply").read_bytes())
    (here / "asks.toml").write_text(f'{job_path("pot").read_text(encoding="utf-8")}\n[batch]\non_refusal = "ask"\n')
    code, _, error = typed("dry-run", "-j", "asks", "--count", "2", "--clock", "virtual")
    assert code == 2 and "there is no terminal to ask at" in " ".join(error.split())
