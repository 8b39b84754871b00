"""The whole product through the door without wires: one thread, no waiting, and the same seed gives the same bytes."""

import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import pytest

from cell import Cell
from cell.config.cell_config import default_toml
from cell.config.job import load_job
from cell.run.events import ConfirmNeeded, Held, RunEnded, RunEvent, StepStarted
from cell.run.job_run import RunOutcome
from cell.run.record.reading import Parts, said
from cell.run.runs import Run
from drivers.errors import Aborted, ConfigError, InterlockError, RefusedError
from statemachine.journal import request
from statemachine.runner import Again, Script
from statemachine.step import Event
from tests.golden.golden import plain_journal, plain_report
from tests.support import Typed
from tests.support.described_cells import LEAN, changed, quick_job

SEED = 2
STOP = "arm.protective_stop@laser_sweep:40%"


@pytest.fixture(autouse=True)
def folder(calibrated_folder: Path) -> Path:
    """The folder of a calibrated cell whose runs leave few files, with the job `pot` in a quarter of the lines."""
    (calibrated_folder / "cell.toml").write_text(changed(default_toml(), LEAN), encoding="utf-8")
    assert load_job(quick_job("pot", calibrated_folder, 15.0))[0].scan.speed == 0.030
    return calibrated_folder


@contextmanager
def opened(**options: Any) -> Iterator[Cell]:
    with Cell.open(sim="all", seed=SEED, clock="virtual", **options) as cell:
        yield cell


def done(inject: tuple[str, ...] = (), until: str | None = None, **options: Any) -> RunOutcome:
    with opened(**options) as cell:
        return cell.run("pot.toml", inject=inject, until=until)


def require_safe(report: dict[str, Any]) -> None:
    """By the world's truth, not by what the devices said."""
    end = report["end_state"]
    assert not end["laser_on"] and not end["rail_moving"] and not end["arm"]["moving"]
    assert end["vehicle"]["braked"] and end["vehicle"]["stopped"]
    assert end["collisions"] == []
    # Whatever fails before the release, the part stays in the claw.
    assert end["part"]["held"] == (report["outcome"] != "placed")


def plain_record(folder: Path) -> list[Any]:
    """All messages of the record with their times: the run's name and date are in its metadata alone."""
    return [(m.topic, m.at, m.schema, m.data) for m in said(folder / "record.mcap", Parts())]


def test_the_same_seed_gives_the_same_bytes_through_a_fault_and_its_recovery():
    """Whether pictures are looked at on one core or on more."""
    Path("cell.toml").unlink()
    first = done((STOP,), confirm="simulated")
    assert first.outcome == "placed"
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1 if threads > 1 else 2)
    try:
        second = done((STOP,), confirm="simulated")
    finally:
        cv2.setNumThreads(threads)
    assert plain_report(first.folder) == plain_report(second.folder)
    assert plain_journal(first.folder) == plain_journal(second.folder)
    assert plain_record(first.folder) == plain_record(second.folder)
    frames = [sorted((run.folder / "frames").iterdir()) for run in (first, second)]
    assert [path.name for path in frames[0]] == [path.name for path in frames[1]]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(*frames, strict=True))
    report = dict(first.report)
    require_safe(report)
    (fault,) = report["faults"]
    assert (fault["code"], fault["remedy"]) == ("arm.protective_stop", "confirmed by the simulated person, recovered")
    assert (report["clock"], report["wall_s"], report["pid"]) == ("virtual", None, None)
    assert report["truth"]["error_mm"]["d"]["mean"] < 3 * report["truth"]["bound_mm"]


def test_a_vehicle_that_was_moved_in_a_fault_is_not_swept_from_where_it_stood():
    with opened(confirm="simulated") as cell:

        def push(event: Event) -> None:
            if event.kind == "recovered" or (event.kind == "state" and event.data["trigger"] == "recovered"):
                cell.simulated.world.vehicle._x += 0.01

        run = cell.start("pot.toml", inject=[STOP])
        notify = run.notify
        run.notify = lambda event: (push(event), notify(event))[1]  # type: ignore[method-assign]
        outcome = run.result(120.0)
    assert (outcome.outcome, outcome.report["refusal"]["step"]) == ("refused", "laser_sweep")
    require_safe(dict(outcome.report))
    assert re.search(r"the board has moved by \d+\.\d+ mm .* since it was photographed", outcome.reason)


def test_a_script_that_allows_one_decision_is_asked_once():
    asked: list[str] = []

    def refuse(_: object) -> None:
        raise RefusedError("not content")

    def again(name: str, _: object) -> Again:
        asked.append(name)
        return Again("drive_to_target", "once more")

    script = Script({"drive_to_target": refuse}, again, most=1)
    with opened() as cell:
        assert cell.run("pot.toml", until="drive_to_target", script=script).outcome == "refused"
    assert asked == ["drive_to_target"]


def test_a_rail_that_is_reset_is_homed_and_sweeps_again():
    outcome = done(("rail.reset@laser_sweep:40%",), until="reconstruct")
    assert outcome.outcome == "done"
    sweep = outcome.report["steps"][2]
    assert (sweep["name"], sweep["retries"]) == ("laser_sweep", 1)
    assert [(fault["code"], fault["remedy"]) for fault in outcome.report["faults"]] == [("rail.reset", "recovered")]


@pytest.mark.parametrize(
    ("inject", "code"),
    [
        ("vehicle.emergency_stop@drive_to_target:40%", "vehicle.emergency_stop"),
        ("vehicle.motor_fault@drive_to_target:40%", "vehicle.error"),
        ("arm.emergency_stop@board_photo", "arm.emergency_stop"),
        ("arm.protective_stop@place:40%", "arm.protective_stop"),
        ("rail.lost_steps@drive_to_target:0%", "rail.lost_steps"),
        ("rail.lost_steps@laser_sweep:1%", "rail.lost_steps"),
        ("rail.lost_steps@place:2%", "rail.lost_steps"),
    ],
)
def test_a_fault_that_no_program_may_clear_ends_the_run_and_leaves_the_cell_safe(inject: str, code: str):
    outcome = done((inject,), confirm="simulated")
    assert (outcome.outcome, outcome.report["code"]) == ("faulted", code)
    assert outcome.reason.startswith(inject.partition(".")[0])
    require_safe(dict(outcome.report))


def test_a_drive_that_is_done_again_in_vain_does_not_look_at_the_fine_board_again():
    """The vehicle may stand before a station that the arm does not know yet."""
    Path("cell.toml").unlink()
    outcome = done(("target_camera.silent@drive_to_target",), confirm="simulated")
    assert (outcome.outcome, outcome.report["code"]) == ("faulted", "DeadlineError")
    assert outcome.reason.startswith("target_camera")
    require_safe(dict(outcome.report))
    step = outcome.report["steps"][0]
    assert (step["name"], step["state"], step["retries"]) == ("drive_to_target", "failed", 1)
    assert len(list((outcome.folder / "frames").glob("interim-1-*.png"))) == 1


def test_a_script_between_the_steps_may_move_what_the_run_may_and_a_stop_before_the_run_is_not_forgotten():
    with opened() as cell:
        rail, moved = cell.devices.rail, []

        def look(result: object) -> None:
            rail.home().wait(60.0)
            rail.move_to(0.01).wait(60.0)
            moved.append(round(rail.state().position, 4))

        cell.stop()
        outcome = cell.run("pot.toml", script=Script(after={"drive_to_target": look}), until="drive_to_target")
        assert (outcome.outcome, moved) == ("done", [0.01]), outcome.reason
        with pytest.raises(InterlockError, match="after_a_stop"):
            rail.move_to(0.02)
        cell.clear_stop("Anna")
        cell.run("pot.toml", until="drive_to_target")
        rail.move_to(0.02).wait(60.0)


@pytest.mark.parametrize("name", ["arm.late_states", "rail.drop_reply", "rail.late_reply", "can.bus_off"])
def test_a_fault_of_a_wire_is_refused_where_there_is_none(name: str):
    with opened() as cell, pytest.raises(ConfigError, match=r"fault of the wire.*use --clock wall"):
        cell.start("pot.toml", inject=[f"{name}@laser_sweep"])


def upto(run: Run[RunOutcome], kind: type[RunEvent], step: str | None = None) -> RunEvent:
    """The first event of this kind, of this step if given."""
    return next(event for event in run.events() if isinstance(event, kind) and step in (None, event.step))


def test_a_protective_stop_waits_for_a_persons_word():
    with opened() as cell:
        run = cell.start("pot.toml", inject=["arm.protective_stop@drive_to_target:10%"], until="drive_to_target")
        needed = upto(run, ConfirmNeeded)
        assert isinstance(needed, ConfirmNeeded)
        with pytest.raises(InterlockError, match="a job is going on"):
            cell.home()
        before = cell.devices.clock.now()
        assert run.confirm("the test", needed.number)
        outcome = run.result(60.0)
        # Nobody waited on the cell's clock meanwhile: the maker's 5 s before a stop can be unlocked came after it.
        assert cell.devices.clock.now() > before + 5.0
    assert outcome.outcome == "done"
    assert outcome.report["faults"][0]["remedy"] == "confirmed by the test, recovered"


@pytest.mark.parametrize("button", ["arm", "vehicle"])
def test_an_emergency_stop_ends_a_run_that_waits_for_a_persons_word(button: str):
    with opened() as cell:
        run = cell.start("pot.toml", inject=["arm.protective_stop@drive_to_target:10%"])
        upto(run, ConfirmNeeded)
        cell.simulated.fault({"arm": "arm.emergency_stop", "vehicle": "vehicle.emergency_stop"}[button])
        outcome = run.result(60.0)
    assert (outcome.outcome, outcome.report["code"]) == ("faulted", f"{button}.emergency_stop")
    assert [fault["code"] for fault in outcome.report["faults"]] == [f"{button}.emergency_stop"]


def test_without_a_word_the_run_waits_and_can_be_ended():
    with opened() as cell:
        run = cell.start("pot.toml", inject=["arm.protective_stop@drive_to_target:10%"])
        upto(run, ConfirmNeeded)
        before = cell.devices.clock.now()
        assert not threading.Event().wait(0.2)
        assert cell.devices.clock.now() == before
        run.abort("enough waited")
        outcome = run.result(60.0)
        assert cell.simulated.truth()["arm"]["safety"] == "protective_stop"
    assert (outcome.outcome, outcome.reason) == ("aborted", "enough waited")


@pytest.mark.parametrize(
    ("way", "step", "reason"),
    [
        ("handle", "drive_to_target", "by its handle"),
        ("journal", "drive_to_target", "by the journal"),
        ("stop", "laser_sweep", "Cell.stop()"),
        ("stop", "reconstruct", "Cell.stop()"),
        ("close", "drive_to_target", "closed"),
    ],
)
def test_who_ends_a_run_from_outside_finds_the_cell_safe(way: str, step: str, reason: str):
    with opened() as cell:
        run = cell.start("pot.toml")
        upto(run, StepStarted, step)
        match way:
            case "handle":
                run.abort("by its handle")
            case "journal":
                request(run.folder, "abort", "by the journal")
            case "stop":
                cell.stop()
            case "close":
                cell.close()
        stood = cell.simulated.truth()["poses"]["base_from_flange"]
        outcome = run.result(60.0)
        if step == "reconstruct":
            # It only computed: nothing may move after the stop.
            assert cell.simulated.truth()["poses"]["base_from_flange"] == stood
        if way == "close":
            with pytest.raises(InterlockError, match="was closed"):
                cell.start("pot.toml")
    assert (outcome.outcome, reason in outcome.reason) == ("aborted", True), outcome.reason
    assert [(row["name"], row["state"]) for row in outcome.report["steps"]][-1] == ("place", "open")
    require_safe(dict(outcome.report))


def test_a_stop_after_a_good_end_is_kept_and_the_next_job_is_not_begun():
    with opened() as cell:
        run = cell.start("pot.toml", until="drive_to_target")
        for event in run.events():
            if isinstance(event, RunEnded):
                # Its report is still to be written.
                cell.stop()
                break
        outcome = run.result(60.0)
        assert (outcome.outcome, outcome.stopped_after_end) == ("done", True)
        with pytest.raises(InterlockError, match="was stopped, and nothing begins"):
            cell.devices.rail.home()
        with pytest.raises(Aborted, match="stopped as the job before had just ended"):
            cell.run("pot.toml", until="drive_to_target")
        # A person who begins it again has seen that.
        again = cell.run("pot.toml", until="drive_to_target")
        assert (again.outcome, again.stopped_after_end) == ("done", False)


def test_a_paused_run_stands_until_it_goes_on():
    with opened() as cell:
        run = cell.start("pot.toml", until="drive_to_target")
        upto(run, StepStarted)
        run.pause()
        upto(run, Held)
        before = cell.devices.clock.now()
        assert not threading.Event().wait(0.1)
        assert cell.devices.clock.now() == before
        # Held, it still hears other processes.
        request(run.folder, "go-on", "by the journal")
        run.events()
        assert run.result(60.0).outcome == "done"


def test_an_aborted_run_is_resumed_through_the_same_door_and_ends_where_it_was_to_end(typed: Typed):
    with opened() as cell:
        cell.pace = 0.5
        run = cell.start("pot.toml", until="board_photo")
        upto(run, StepStarted, "board_photo")
        run.abort("to be resumed")
        aborted = run.result(60.0)
    assert (aborted.outcome, aborted.report["until"]) == ("aborted", "board_photo")
    code, out, _ = typed("resume", aborted.folder.name, "--json")
    report = json.loads(out)
    assert (code, report["outcome"], report["clock"], report["until"]) == (0, "done", "virtual", "board_photo")
    assert (report["resumed_from"], report["pace"]) == (aborted.folder.name, 0.5)
    with opened() as cell, pytest.raises(ConfigError, match="has ended done"):
        cell.resume(cell.runs_folder / report["run"])


def test_a_run_that_a_script_looked_at_is_resumed_with_a_script_only():
    def abort(result: object) -> None:
        raise Aborted("to be resumed")

    script = Script(after={"drive_to_target": abort})
    with opened() as cell:
        aborted = cell.run("pot.toml", script=script)
        assert (aborted.outcome, aborted.report["scripted"]) == ("aborted", True)
        with pytest.raises(ConfigError, match="was looked at by a script"):
            cell.resume(aborted.folder)
        assert cell.resume(aborted.folder, script=script).outcome == "aborted"


def test_the_command_line_says_what_time_passed_here_and_there(typed: Typed):
    virtual = ("dry-run", "-j", "pot.toml", "--clock", "virtual", "--seed", str(SEED), "--until", "drive_to_target")
    code, out, _ = typed(*virtual)
    assert code == 0 and re.search(r"whole run +\d+\.\d\d s +\d+\.\d\d s", out)
    assert typed(*virtual, "--speed", "2")[0] == 2


def test_a_run_goes_at_the_pace_that_was_set(tmp_path):
    # How often a job looks at the fine board is chance.
    unlooked = tmp_path / "cell.toml"
    unlooked.write_text(default_toml().replace("each_job = true", "each_job = false"))
    times = []
    for share in (1.0, 0.5):
        with opened(config=unlooked) as cell:
            cell.pace = share
            report = cell.run("pot.toml", until="board_photo").report
        times.append({step["name"]: step["duration_s"] for step in report["steps"]})
    for step in ("drive_to_target", "board_photo"):
        assert 1.4 < times[1][step] / times[0][step] < 2.0, step
