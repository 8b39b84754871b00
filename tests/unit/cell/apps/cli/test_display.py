"""What a person sees: a run's end on one screen of 80 by 24, and a list of the runs that nothing spoils."""

import json
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from cell.apps.cli.display import HEIGHT, duration, end_screen, next_step, print_report
from cell.base.storage import write_json
from cell.config.job import job_path
from cell.run.folder import new_run, read_report, run_row
from statemachine.journal import Journal
from tests.support import Typed, report_runs
from tests.support.report_runs import NAMES, Ended, Ends, Make

MAKES: list[tuple[Make, str]] = [
    (report_runs.placed, "placed"), (report_runs.real, "placed"), (report_runs.no_board, "refused"),
    (report_runs.too_strict, "refused"), (report_runs.faulted, "faulted"), (report_runs.aborted, "aborted"),
]  # fmt: skip
CALIBRATION = {
    "kind": "calibration", "outcome": "done", "reason": "stored", "started": "2026-03-01T10:00:00+0100",
    "ended": "2026-03-01T10:02:05+0100", "wall_s": 125.0,
}  # fmt: skip


def shown(run: Ended, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, **asked: bool) -> str:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("LINES", "24")
    print_report(run.report, str(run.folder), **asked)
    return capsys.readouterr().out


@pytest.mark.parametrize(("make", "outcome"), MAKES)
def test_the_end_of_a_run_is_one_screen(ends: Ends, make: Make, outcome: str, capsys, monkeypatch):
    run = ends(make)
    monkeypatch.chdir(run.folder.parent.parent)
    lines = shown(run, capsys, monkeypatch).splitlines()
    assert len(lines) < 24
    assert max(map(len, lines)) <= 80
    assert lines[0].startswith(f"{outcome}  ")
    text = "\n".join(lines)
    assert "cell time" in text and "wall time" in text
    assert [line[:18].strip() for line in lines if line[:18].strip() in NAMES] == NAMES
    assert f"runs/{run.folder.name}/report.json" in text
    assert any(line.startswith("next ") and "cell " in line for line in lines)
    assert any(line.startswith("faults ") for line in lines)


def test_a_placed_run_shows_what_was_measured_beside_its_limit(ends: Ends, capsys, monkeypatch):
    text = shown(ends(report_runs.placed), capsys, monkeypatch)
    for name in ("place error, largest of 45 points", "place error, stated 95 % bound", "contact depth", "fit, χ²/dof",
                 "surface covered"):  # fmt: skip
        (line,) = (line for line in text.splitlines() if name in line)
        assert any(bound in line for bound in ("at most", "at least", "about"))
    assert "at most 0.6 mm" in text
    assert "faults    1: camera.frames_lost in laser_sweep, tried again" in text
    assert "retries   laser_sweep 1" in text
    assert "Handscan" not in text


def test_the_noise_is_shown_where_it_is_asked_for(ends: Ends, capsys, monkeypatch):
    assert "assumed noise" not in shown(ends(report_runs.placed), capsys, monkeypatch)
    assert "assumed noise" in shown(ends(report_runs.placed), capsys, monkeypatch, noise=True)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (report_runs.placed, "cell export"),
        (report_runs.no_board, "picture.png beside it shows why; put that right, then cell dry-run --seed"),
        (report_runs.faulted, "cell resume"),
        (report_runs.aborted, "cell resume"),
    ],
)
def test_what_to_type_next_depends_on_the_end(ends: Ends, make: Make, words: str):
    run = ends(make)
    screen = end_screen(run.report, run.folder)
    advice = next(k for k, line in enumerate(screen) if line.startswith("next"))
    assert words in " ".join(" ".join(screen[advice:]).split())


@pytest.mark.parametrize(
    ("part", "words"), [("released", "look at the part, it is down"), ("unknown", "what has become")]
)
@pytest.mark.parametrize("outcome", ["refused", "faulted", "aborted", "not ended"])
def test_whoever_has_lost_a_part_is_not_told_to_resume(tmp_path, outcome: str, part: str, words: str):
    report = {"outcome": outcome, "reason": "a link broke", "job": "pot", "part": part, "simulated": False}
    text = "\n".join(end_screen(report, tmp_path))
    assert words in text
    assert "resume" not in text


def test_what_became_of_the_part_of_a_killed_run_is_in_its_journal(tmp_path):
    journal = Journal(tmp_path, "run", {"job": "pot"})
    journal.event("note", "place", {"part": "unknown"})
    journal.close()
    assert read_report(tmp_path)["part"] == "unknown"


@pytest.mark.parametrize(
    ("about", "words"),
    [
        ({"code": "CalibrationStale", "simulated": False}, "cell calibrate, then cell run -j pot"),
        ({"simulated": True, "seed": 7, "level": "workshop", "clock": "virtual"},
         "then cell dry-run --seed 7 --level workshop --clock virtual -j pot"),
    ],
)  # fmt: skip
def test_a_refused_run_is_done_again_calibrated_or_in_its_own_world(tmp_path, about: Any, words: str):
    report = {"outcome": "refused", "reason": "no", "job": "pot", **about}
    assert words in " ".join("\n".join(end_screen(report, tmp_path)).split())


def test_what_a_screen_leaves_out_is_counted_and_the_report_has_it(ends: Ends):
    run = ends(report_runs.placed)
    rows = [{**run.report["measured"][0], "name": f"figure {k}"} for k in range(30)]
    long = {**run.report, "measured": rows, "reason": "it is so. " * 60}
    short, whole = (end_screen(long, run.folder, whole=whole) for whole in (False, True))
    named = [line for line in short if "figure " in line]
    assert len(short) <= HEIGHT
    assert any(f"and {30 - len(named)} more: cell report" in line for line in short)
    assert [sum("figure " in line for line in whole), " ".join(whole).count("it is so.")] == [30, 60]


def test_a_reason_however_long_leaves_room_for_the_rest(ends: Ends):
    run = ends(report_runs.faulted)
    many = [{**run.report["faults"][0]}] * 30
    lines = end_screen({**run.report, "reason": "word " * 400, "faults": many}, run.folder)
    assert len(lines) <= HEIGHT
    assert sum(line.startswith("word ") and line.endswith("…") for line in lines) == 1
    assert any(line.startswith("faults    30: ") for line in lines)


def test_a_run_without_steps_has_its_screen_too(tmp_path, capsys):
    print_report(CALIBRATION, str(tmp_path / "20260301T100000-0001"), noise=True)
    text = capsys.readouterr().out
    assert text.startswith("done  stored\ncalibration · 2 min on the wall")
    assert "next      cell calibrate verify" in text


@pytest.mark.parametrize(
    ("seconds", "words"), [(None, ""), (3.21, "3.2 s"), (31.4, "31 s"), (125.0, "2 min"), (7300.0, "2 h 2 min")]
)
def test_durations_are_told_as_people_do(seconds: float | None, words: str):
    assert duration(seconds) == words


# --- cell runs, cell report ---


SPOILED = ["torn", "empty", "foreign", "list", "rows", "nothing", "journal", "no journal"]


def spoiled(root: Path) -> dict[str, Path]:
    """Run folders in which something is wrong."""
    folders = {name: new_run(root) for name in SPOILED}
    (folders["torn"] / "report.json").write_text('{"outcome": "placed", "steps": [{"na', encoding="utf-8")
    (folders["empty"] / "report.json").write_bytes(b"")
    (folders["foreign"] / "report.json").write_text('{"tests": 12}', encoding="utf-8")
    (folders["list"] / "report.json").write_bytes(b"[1, 2]\xff")
    write_json(folders["rows"] / "report.json", {"outcome": "placed", "steps": ["drive"]})
    (folders["journal"] / "journal.sqlite").write_bytes(b"SQLite format 3\0" + 400 * b"\x13")
    sqlite3.connect(folders["no journal"] / "journal.sqlite").close()
    return folders


@pytest.fixture
def root(here: Path, monkeypatch) -> Path:
    monkeypatch.setenv("COLUMNS", "80")
    return here / "runs"


def test_one_bad_report_does_not_spoil_the_list(root: Path, typed: Typed):
    good = new_run(root)
    write_json(good / "report.json", {"run": good.name, "outcome": "placed", "job": "pot", "wall_s": 31.2})
    folders = spoiled(root)
    code, out, _ = typed("runs", "--json")
    rows: dict[str, dict[str, Any]] = {row["run"]: row for row in json.loads(out)}
    assert code == 0
    assert len(rows) == 1 + len(folders)
    assert (rows[good.name]["outcome"], rows[good.name]["duration_s"]) == ("placed", 31.2)
    for folder in folders.values():
        assert rows[folder.name]["outcome"] == "unreadable"
        assert folder.name in rows[folder.name]["reason"]
    code, out, _ = typed("runs")
    lines = out.splitlines()
    assert code == 0
    assert len(lines) == 1 + len(folders)
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("name", SPOILED)
def test_a_report_that_cannot_be_read_is_an_error_in_our_words(root: Path, typed: Typed, name: str):
    folder = spoiled(root)[name]
    code, _, said = typed("report", folder.name)
    assert code in (1, 2)
    assert said.startswith("error: ")
    assert folder.name in said
    assert "Traceback" not in said


def test_the_list_tells_when_what_how_and_how_long(root: Path, ends: Ends, typed: Typed):
    for data in (CALIBRATION, ends(report_runs.too_strict).report):
        write_json(new_run(root) / "report.json", data)
    going_on = new_run(root)
    journal = Journal(going_on, going_on.name, {"job": "pot", "seed": 3})
    journal.step_ended(journal.step_started("drive_to_target", 1), 1.5, error="lost")
    journal.step_ended(journal.step_started("drive_to_target", 2), 2.0, {})
    journal.close()
    code, out, _ = typed("runs", "--json")
    rows = json.loads(out)
    assert code == 0
    keys = {"run", "outcome", "job", "simulated", "seed", "level", "reason", "kind", "started", "duration_s"}
    assert all(set(row) == keys for row in rows)
    kinds = {row["kind"]: row for row in rows}
    assert kinds["calibration"]["duration_s"] == 125.0
    assert run_row(going_on)["outcome"] == "not ended"
    (step,) = read_report(going_on)["steps"]
    assert (step["state"], step["retries"], step["duration_s"]) == ("done", 1, 3.5)
    code, text, _ = typed("runs")
    assert code == 0
    assert "2026-03-01 10:00" in text and "2 min  stored" in text and "job pot (sim)" in text
    assert "31 s  translation" in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_long_reason_keeps_what_to_do_about_it(tmp_path):
    remedy = "Scan more of the surface, or photograph the board more often"
    reason = f"{'; '.join(f'translation {k} is not determined: 0.181 mm > 0.1 mm' for k in range(9))}. {remedy}"
    rows = [{"name": f"figure {k}", "value": 0.1, "unit": "mm", "limit": None} for k in range(20)]
    lines = end_screen({"outcome": "refused", "reason": reason, "measured": rows}, tmp_path)
    assert lines[2] == remedy
    assert lines[1].endswith(" …")
    assert remedy in " ".join(end_screen({"outcome": "refused", "reason": reason}, tmp_path))


def test_the_next_command_names_a_cell_that_is_elsewhere(tmp_path):
    report = {"outcome": "aborted", "reason": "no", "job": "pot", "simulated": False}
    folder = tmp_path / "my cell" / "runs" / "20261124T120000-aaaa"
    folder.mkdir(parents=True)
    assert next_step(report, folder) == "cell resume aaaa: go on with the job"
    (tmp_path / "my cell" / "cell.toml").touch()
    item = {**report, "outcome": "refused", "job_file": f"{job_path('swap')}#2"}
    assert str(next_step(item, folder)).endswith(" -j swap#2")
    assert "job swap#2 at stop right" in "\n".join(end_screen({**item, "job": "swap#2", "stop": "right"}, folder))
    down = {**item, "part": "released", "next_item": f"{job_path('tray4')}#3"}
    assert str(next_step(down, folder)).endswith(" -j tray4#3")
    assert " -j tray4#3: the next item; " in str(next_step({**down, "outcome": "placed"}, folder))
    for kind, outcome in (("unload", "aborted"), ("load", "refused")):
        held = {**report, "part": "held", "job_kind": kind, "outcome": outcome}
        assert str(next_step(held, folder)).startswith("take the part out of the claw; ")
    assert next_step(report, folder) == f"cell resume aaaa -c '{tmp_path}/my cell/cell.toml': go on with the job"


@pytest.mark.parametrize(
    ("outcome", "reason", "words"),
    [
        ("faulted", "no life (rail.owner_frozen). End", "put that right, then cell dry-run --clock virtual -j pot"),
        ("refused", "no board", "another --seed draws another world; put that right, then cell dry-run -j pot"),
    ],
)  # fmt: skip
def test_after_a_simulated_calibration_the_next_command_fits_its_end(tmp_path, outcome: str, reason: str, words: str):
    report = {"kind": "calibration", "outcome": outcome, "reason": reason, "simulated": True, "for_job": "pot"}
    assert next_step(report, tmp_path / "runs" / "20261124T120000-aaaa") == words
