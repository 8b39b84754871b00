"""A run's page: one file that asks for nothing, says what the report says, and what it cannot show."""

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cell.apps.cli.app import app
from cell.base.storage import write_json
from cell.measure.reconstruction.ply import write_cloud
from cell.run.report.page.make import MOST_BYTES, compared, identities, judged, make_page, verdict, write_page
from drivers.errors import CellError
from lab.bench.job.whole_job import JobRecord
from statemachine.journal import Journal
from tests.support import report_runs
from tests.support.report_runs import Ended, Ends, pot

VOID = {"br", "meta", "img", "line", "rect", "circle"}


class Page(HTMLParser):
    """Reads a page as a browser does: its text, its tags in pairs, and whatever it could ask for."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.asked: list[str] = []
        self.words: list[str] = []
        self.scripts = ""
        self.feed(page)
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open += [] if tag in VOID else [tag]
        for name, value in attrs:
            if name in ("src", "href", "action", "data", "srcset") and not str(value).startswith("data:image/"):
                self.asked.append(str(value))

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["script"]:
            self.scripts += data
        else:
            self.words.append(data)


@pytest.fixture(scope="module")
def folder(placed_pot: JobRecord, ends: Ends, tmp_path_factory) -> Path:
    """A placed run with what a whole run leaves: cloud, job and journal."""
    folder = tmp_path_factory.mktemp("page") / ends(report_runs.placed).folder.name
    shutil.copytree(ends(report_runs.placed).folder, folder)
    made = placed_pot.results["reconstruct"]
    write_cloud(folder / "cloud.ply", made.cloud)
    write_json(folder / "job.json", pot()[0].model_dump(mode="json"))
    journal = Journal(folder, folder.name, {"clock": "virtual"})
    for name, attempt, error in (("laser_sweep", 1, "frames were lost"), ("laser_sweep", 2, None)):
        journal.step_ended(journal.step_started(name, attempt), 2.0 * attempt, {}, error)
    journal.close()
    return folder


def test_the_page_of_a_placed_run(folder: Path):
    text = make_page(folder)
    page = Page(text)
    report = json.loads((folder / "report.json").read_text())
    assert len(text.encode()) < MOST_BYTES
    assert page.asked == []
    # An inline script or style could ask as well; the policy is what a browser holds it to.
    assert "default-src 'none'; img-src data:;" in text
    assert not re.search(r"https?:|@import|url\(|fetch|XMLHttp|import\(", text)
    true, stated = report["truth"]["error_mm"]["d"]["max"], report["place_bound_95"]["d"]
    for said in (
        f"{true:.3f} mm (simulated world)", f"{stated:.3f} mm", "tolerance 0.6 mm", "Simulated",
        report["calibration_hash"], report["job_hash"], "camera.frames_lost in laser_sweep", "camera's read noise",
    ):  # fmt: skip
        assert said in page.text, said
    data = json.loads(re.findall(r'id="cloud-data">(.*?)</script>', text)[0])
    assert f"{data['count']} of {data['total']} measured points are shown" in page.text


def test_a_report_is_not_believed_to_be_harmless(folder: Path, tmp_path):
    hostile = "</script><script>alert(1)</script><img src=http://elsewhere/x>"
    run = tmp_path / folder.name
    run.mkdir()
    report = json.loads((folder / "report.json").read_text())
    report.update(outcome="refused", reason=hostile, job=hostile, cell=hostile, truth=None, place_pose=None)
    report["refusal"] = {"step": hostile, "reason": hostile, "numbers": [], "frames": [], "cloud": None}
    report["faults"] = [{"at": report["started"], "step": hostile, "attempt": 1, "code": hostile, "reason": hostile}]
    report["measured"][0].update(name=hostile, kept=False)
    write_json(run / "report.json", report)
    page = Page(make_page(run))
    assert page.asked == []
    assert "alert(1)" not in page.scripts
    assert hostile in page.text and "one figure outside its limit" in page.text


@pytest.mark.parametrize("make", [report_runs.too_strict, report_runs.no_board, report_runs.faulted])
def test_a_run_that_did_not_place_says_why_with_its_numbers(ends: Ends, make: report_runs.Make):
    ended: Ended = ends(make)
    text = make_page(ended.folder)
    page = Page(text)
    assert " ".join(ended.report["reason"].split()) in page.text
    assert ended.report["outcome"] in page.text
    for row in (ended.report["refusal"] or {"numbers": []})["numbers"]:
        assert row["name"] in page.text
    assert "data:image/jpeg;base64," in text


def test_what_cannot_be_read_of_a_run_is_said_on_its_page(folder: Path, tmp_path):
    run = tmp_path / folder.name
    shutil.copytree(folder, run)
    report = json.loads((folder / "report.json").read_text())
    write_json(run / "report.json", {**report, "mesh": {**report["mesh"], "sha256": 64 * "0"}})
    text = Page(make_page(run)).text
    assert "pot.ply was changed since the run" in text and "mm (height)" in text
    (run / "cloud.ply").write_bytes(b"ply\n")
    assert "is no cloud of this program" in Page(make_page(run)).text
    write_json(run / "report.json", {**report, "measured": [{"kept": True}]})
    with pytest.raises(CellError, match="not as this version writes it"):
        make_page(run)


def test_the_command_writes_it_beside_the_run_or_where_it_is_asked_to(tmp_path):
    run = tmp_path / "20260101T000000-0001"
    run.mkdir()
    Journal(run, run.name, {"kind": "home"}).close()
    told = CliRunner().invoke(app, ["report", str(run), "--html", "--json"])
    assert json.loads(told.stdout) == {
        "run": run.name, "file": str(run / "report.html"), "bytes": (run / "report.html").stat().st_size,
    }  # fmt: skip
    assert "not ended" in Page((run / "report.html").read_text()).text
    with pytest.raises(CellError, match="--out"):
        write_page(run, tmp_path / "nowhere" / "page.html")


TOLERANCE = {"tolerance": {"translation_mm": 0.6}}
BOUND = {"place_bound_95": {"x": 0.1, "y": 0.1, "z": 0.2, "d": 0.25}}
OUTSIDE = {"name": "first touch", "value": 2.0, "unit": "mm", "limit": 1.0, "bound": "at most", "kept": False}


@pytest.mark.parametrize(
    ("report", "words", "good"),
    [
        ({"outcome": "placed"}, "", True),
        ({"outcome": "faulted", **TOLERANCE}, "", False),
        ({"outcome": "placed", **TOLERANCE, **BOUND}, "stated: 95 % within 0.250 mm; tolerance 0.6 mm", True),
        ({"outcome": "placed", "measured": [OUTSIDE]}, "one figure outside its limit", False),
        ({"outcome": "done", "measured": [OUTSIDE, OUTSIDE]}, "2 figures outside their limits", False),
    ],
)
def test_a_verdict_is_good_only_where_every_figure_keeps_its_limit(report: dict[str, Any], words: str, good: bool):
    told = verdict(report)
    assert (told.words, told.good) == (words, good)
    assert [row.kept for row in judged(report)] == [False] * len(report.get("measured", ()))


def test_what_was_not_measured_is_not_called_an_actual_value():
    rows = {row.cells[0]: row.cells for row in compared({**TOLERANCE, **BOUND, "measured": [OUTSIDE]})}
    assert rows["part's points, largest D"][1:] == ("0 mm", "not measured", "", "at most 0.6 mm", "0.250 mm")
    assert rows["part's points, largest along z"][4:] == ("", "0.200 mm")


@pytest.mark.parametrize(
    ("seconds", "age"), [(30, "30 s"), (150, "2 min"), (9000, "2 h"), (200_000, "2 days"), (None, "made 2026-01-01")]
)
def test_a_calibration_is_told_with_its_age(tmp_path, seconds: float | None, age: str):
    began = 1_790_000_000.0
    write_json(tmp_path / "calibration.json", {} if seconds is None else {"made": began - seconds})
    report = {"started": "2026-09-21T14:13:20+00:00", "calibration_hash": "abc", "calibration_date": "2026-01-01"}
    told = dict(row.cells for row in identities(tmp_path, report))["calibration"]
    assert told.startswith("hash abc, made 2026-01-01") and age in told


def test_where_nobody_knows_the_truth_the_part_is_where_it_was_seen():
    seen = {"off_mm": 0.08, "shift_mm": [0.05, -0.06, 0.01]}
    for more in ({"steps": [{"name": "verify", "result": seen}]}, {"refusal": {"placed": seen}}):
        rows = {row.cells[0]: row.cells for row in compared({**TOLERANCE, **BOUND, **more})}
        assert rows["part's points, as seen, mean along y"][2] == "0.060 mm"
        assert rows["part's points, as seen, mean D"][1:5] == ("0 mm", "0.080 mm", "0.080 mm", "at most 0.6 mm")
    partly = {"steps": [{"name": "verify", "result": {**seen, "unseen": ["translation along the x axis"]}}]}
    rows = {row.cells[0]: row.cells for row in compared({**TOLERANCE, **BOUND, **partly})}
    assert rows["part's points, largest D"][2] == "not measured", "where it lies along x is as stated, not as seen"
