"""What a run says at its end: a refusal leaves what it looked at, the report is strict and documented, and what it
states of its own error is what its covariance says."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.stats import chi2, norm

from cell.config.job import SwathSection
from cell.measure.reconstruction.ply import read_cloud
from cell.procedures.frame_store import FrameStore
from cell.procedures.part_error import stated_bound
from cell.procedures.steps.reconstruct import Reconstruction
from cell.run.folder import write_json
from cell.run.job_run import RunOutcome
from cell.run.report.pictures import SurfacePanel, draw_surface
from cell.run.report.report import strict
from drivers.errors import CellError, Measured, RefusedError
from drivers.interfaces import Frame
from lab.bench.job.whole_job import JobRecord, run_whole_job
from tests.support import ROOT, report_runs
from tests.support.report_runs import CONFIG, Ended, Ends, Make, pot

DOCUMENT = ROOT / "docs" / "reference" / "report.md"
REFUSALS: list[tuple[Make, str, str | None, bool, bool]] = [
    (report_runs.no_board, "drive_to_target", None, True, False),
    (report_runs.blurred_board, "drive_to_target", "board's dots off their places, RMS", True, False),
    (report_runs.few_points, "reconstruct", "points of the cloud", False, True),
    (report_runs.other_surface, "invert_pose", "points over the surface that fit it", False, False),
    (report_runs.too_strict, "invert_pose", "3σ in tolerances: translation along the z axis", False, False),
    (report_runs.no_contact, "place", None, True, False),
]


def read_strictly(path: Path) -> dict[str, Any]:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    return report


@pytest.fixture(scope="module")
def placed(ends: Ends) -> Ended:
    return ends(report_runs.placed)


@pytest.mark.parametrize(("make", "step", "number", "frames", "cloud"), REFUSALS)
def test_a_refusal_leaves_what_it_looked_at(
    ends: Ends, make: Make, step: str, number: str | None, frames: bool, cloud: bool
) -> None:
    run = ends(make)
    report = read_strictly(run.folder / "report.json")
    assert report["outcome"] == "refused"
    refusal = report["refusal"]
    assert (refusal["step"], refusal["reason"]) == (step, report["reason"])
    if number is not None:
        first = refusal["numbers"][0]
        assert (first["name"], first["kept"]) == (number, False)
        assert first["value"] < first["limit"] if first["bound"] == "at least" else first["value"] > first["limit"]
        assert report["measured"][0] == first
    assert bool(refusal["frames"]) == frames
    for name in refusal["frames"]:
        assert cv2.imread(str(run.folder / name), cv2.IMREAD_GRAYSCALE) is not None
    assert (refusal["cloud"] == "cloud.ply") == cloud
    if cloud:
        assert 0 < len(read_cloud(run.folder / "cloud.ply").points) < 500
    assert "picture_missing" not in report
    assert cv2.imread(str(run.folder / "picture.png")).shape[1] > 1500


def test_a_place_that_was_refused_is_shown_with_all_its_figures(ends: Ends) -> None:
    run = ends(report_runs.other_surface)
    names = {row["name"] for row in run.report["refusal"]["numbers"]}
    assert {"fit, χ²/dof", "surface covered", "points off the surface, RMS"} <= names
    assert run.report["place_pose"] is None


def test_a_part_that_met_nothing_says_how_far_it_was_lowered(ends: Ends) -> None:
    (number,) = ends(report_runs.no_contact).report["refusal"]["numbers"]
    assert number["name"] == "reached without contact"
    assert number["value"] == pytest.approx(-1.0, abs=0.1)


def test_a_photograph_is_kept_before_it_is_looked_at(ends: Ends) -> None:
    run = ends(report_runs.no_board)
    # One from where the vehicle started, one after it drove on odometry: neither showed the board of the job.
    assert [Path(name).name[:9] for name in run.report["refusal"]["frames"]] == ["board-01-", "board-02-"]


def test_evidence_nearest_to_the_cause_stays() -> None:
    error = RefusedError("too little", Measured("points", 3, least=5)).showing(
        Measured("points", 4, least=5), Measured("rms", 0.1, "mm", most=0.3), seen={"frame": 1}
    )
    error.showing(seen={"frame": 2, "pose": 3})
    assert [(number.name, number.value) for number in error.numbers] == [("points", 3), ("rms", 0.1)]
    assert error.seen == {"frame": 1, "pose": 3}
    assert str(error) == "too little"


def test_a_fault_keeps_the_last_frames_and_every_fault_before_it(ends: Ends) -> None:
    run = ends(report_runs.faulted)
    report = read_strictly(run.folder / "report.json")
    assert report["refusal"] is None
    assert [(run.folder / name).is_file() for name in report["last_frames"]] == [True]
    first, last = report["faults"]
    assert (first["code"], first["step"], first["attempt"]) == ("camera.frames_lost", "laser_sweep", 1)
    assert (first["remedy"], last["remedy"]) == ("tried again", "ended the run")
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d{4}", first["at"])


def test_only_the_frames_of_the_last_step_are_its_evidence(tmp_path: Path) -> None:
    def frame(number: int) -> Frame:
        return Frame(np.zeros((4, 4), np.uint8), number, 0.01, 0.0, 0.0, 0.0)

    with FrameStore(tmp_path / "frames") as store:
        store.keep("board-01", frame(1))
        store.begin()
        for number in range(2, 40):
            store.keep("stripe", frame(number))
    assert store.recent[-1] == "stripe-000039.png"
    assert len(store.recent) == 12
    assert len(list((tmp_path / "frames").iterdir())) == 39


def test_a_placed_run_measures_itself_against_its_limits(placed: Ended) -> None:
    rows = {row["name"]: row for row in placed.report["measured"]}
    assert all(row["kept"] for row in rows.values())
    truth = placed.report["truth"]
    assert rows["place error, largest of 45 points"]["value"] == truth["error_mm"]["d"]["max"]
    assert rows["place error, largest of 45 points"]["limit"] == 0.6
    assert rows["place error, stated 95 % bound"]["limit"] == 0.6
    assert rows["contact depth"]["limit"] == 1.0
    assert rows["surface covered"]["limit"] == 35.0
    assert 0.5 < rows["fit, χ²/dof"]["value"] < 2.0


def test_a_real_cell_has_its_own_figures(ends: Ends) -> None:
    report = ends(report_runs.real).report
    assert report["truth"] is None
    names = [row["name"] for row in report["measured"]]
    assert names[:5] == [
        "place error, stated 95 % bound",
        "contact depth",
        "first touch, off what the scan says",
        "fit, χ²/dof",
        "surface covered",
    ]


def test_the_stated_bound_is_the_closed_form_for_a_round_error(placed_pot: JobRecord) -> None:
    job, nominal = pot()
    sigma = 5e-5
    round_error = np.diag([sigma**2] * 3 + [1e-20] * 3)
    pose = replace(placed_pot.results["invert_pose"], covariance=round_error)
    bound = stated_bound(job, nominal, pose, np.zeros((6, 6)))
    for axis in "xyz":
        assert bound[axis] == pytest.approx(1e3 * sigma * norm.ppf(0.975), rel=0.05)
    assert bound["d"] == pytest.approx(1e3 * sigma * np.sqrt(chi2.ppf(0.95, 3)), rel=0.05)
    twice = stated_bound(job, nominal, pose, 3 * round_error)
    assert twice["d"] == pytest.approx(2 * bound["d"], rel=1e-6)


def test_the_bound_is_in_the_surfaces_axes(placed_pot: JobRecord) -> None:
    job, nominal = pot()
    found = placed_pot.results["invert_pose"]
    along_x = found.base_from_surface.rotation[:, 0]
    covariance = np.diag([1e-18] * 3 + [1e-20] * 3)
    covariance[:3, :3] += 1e-8 * np.outer(along_x, along_x)
    bound = stated_bound(job, nominal, replace(found, covariance=covariance), np.zeros((6, 6)))
    assert bound["x"] == pytest.approx(0.196, rel=0.05)
    assert max(bound["y"], bound["z"]) < 1e-4


def test_no_number_that_is_none_comes_into_the_report(placed_pot: JobRecord, tmp_path: Path) -> None:
    broken = replace(placed_pot.results["place"], depth_error=float("nan"))
    record = replace(placed_pot, results={**placed_pot.results, "place": broken})
    run = report_runs.real(record, tmp_path / "runs")
    report = read_strictly(run.folder / "report.json")
    assert report["steps"][-1]["result"]["depth_error_mm"] is None
    assert run.report == report
    with pytest.raises(CellError, match="no number"):
        write_json(tmp_path / "x.json", {"value": float("inf")})
    assert not list(tmp_path.glob("x*"))
    assert strict({"a": (np.float32(1.5), np.int64(2), float("-inf"))}) == {"a": [1.5, 2, None]}
    # What a foreign step may have said.
    assert strict({"at": np.array([[1.0, np.nan]]), "file": Path("x")}) == {"at": [[1.0, None]], "file": "x"}


# --- docs/reference/report.md ---


def keys(value: object, at: str = "") -> set[str]:
    """Paths of all leaves of a report; those of a step's result begin with the step's name."""
    if isinstance(value, dict):
        if at == "steps[]" and value.get("result") is not None:
            told = keys(value["result"], value["name"])
            return told | {"steps[].result"} | keys({k: v for k, v in value.items() if k != "result"}, at)
        if at == "assumed_noise.sigmas":
            return set().union(*(keys(entry, f"{at}.*") for entry in value.values()))
        return set().union(*(keys(entry, f"{at}.{name}" if at else str(name)) for name, entry in value.items()))
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return {at}.union(*(keys(entry, f"{at}[]") for entry in value))
    return {at}


def documented() -> set[str]:
    found, section = set(), ""
    for line in DOCUMENT.read_text(encoding="utf-8").splitlines():
        if line.startswith("### "):
            section = f"{line[4:]}."
        elif line.startswith("## "):
            section = ""
        elif line.startswith("| `"):
            found |= {f"{section}{key}" for key in re.findall(r"`([^`]+)`", line.split("|")[1])}
    return found


@pytest.fixture(scope="module")
def two_sweeps(placed_pot: JobRecord, tmp_path_factory: pytest.TempPathFactory) -> Ended:
    """The middle of the pot in two sweeps side by side."""
    job, nominal = pot(length=0.036, swath=(SwathSection(across="-4 mm"), SwathSection(across="4 mm")))
    record = run_whole_job(CONFIG, job, nominal, 2, "nominal", calibrated=placed_pot)
    assert (record.outcome, record.reason) == ("placed", "")
    return report_runs.placed(record, tmp_path_factory.mktemp("two") / "runs")


def test_every_key_of_a_report_is_documented_and_every_documented_key_exists(
    ends: Ends, placed: Ended, two_sweeps: Ended
) -> None:
    others = (report_runs.too_strict, report_runs.faulted, report_runs.aborted)
    reports = [placed.report, two_sweeps.report, *(ends(make).report for make in others)]
    found = set().union(*(keys(report) for report in reports))
    # What other places of the program add, each only where something out of the ordinary was asked for or went wrong.
    elsewhere = {
        "injected", "not_injected", "not_injected[].fault", "not_injected[].why", "until", "scripted", "resumed_from",
        "frames_missing", "truth_missing", "picture_missing",
    }  # fmt: skip
    assert found - documented() == set()
    # What only devices that are simulated beside real ones have is compared where there are some.
    following = {key for key in documented() if key.startswith("following.")}
    parents = {key for key in documented() if any(other.startswith((f"{key}.", f"{key}[")) for other in found)}
    assert documented() - found - parents - following == elsewhere


def test_what_went_wrong_with_the_report_itself_is_told_in_it(placed_pot: JobRecord, tmp_path: Path) -> None:
    run = report_runs.crippled(placed_pot, tmp_path / "runs")
    assert {"frames_missing", "truth_missing", "picture_missing"} <= set(run.report)
    assert run.report["outcome"] == "placed"


def test_the_report_keeps_its_contract(placed: Ended) -> None:
    report = read_strictly(placed.folder / "report.json")
    assert {"outcome", "seed", "level", "steps", "place_pose", "place_sigma", "assumed_noise", "truth"} <= set(report)
    assert all({"name", "state", "duration_s", "retries", "wall_s"} <= set(step) for step in report["steps"])
    assert {"points", "error_mm", "d_p95", "sensor_mm", "bound_mm"} <= set(report["truth"])
    assert (report["kind"], len(report["mesh"]["sha256"])) == ("job", 64)
    assert report["started"] < report["ended"]


# --- the picture ---


def surface_axes(panel: SurfacePanel, seams: list[dict[str, Any]]) -> tuple[Any, Any]:
    figure = Figure()
    axes = figure.subplots()
    draw_surface(figure, axes, panel, 0.2, seams)
    return axes, figure.axes[1]


def test_the_map_of_deviations_has_a_fixed_scale_in_mm(placed_pot: JobRecord) -> None:
    made = placed_pot.results["reconstruct"]
    assert isinstance(made, Reconstruction)
    points = np.column_stack([*np.random.default_rng(1).uniform(-0.02, 0.02, (2, 4000)), np.zeros(4000)])
    for size in (1e-6, 1e-3):
        axes, colours = surface_axes(SurfacePanel(points, np.full(4000, size), believed=True), [])
        assert colours.get_ylim() == (-0.2, 0.2)
        assert colours.get_ylabel() == "deviation from the drawn surface in mm"
        assert f"{1e3 * size:.3f} mm RMS" in axes.get_title()
        assert axes.get_xlabel().endswith("in mm")


def test_a_surface_that_was_not_found_is_shown_by_its_height() -> None:
    points = np.array([[0.0, 0.0, 0.001], [0.01, 0.0, 0.002]])
    axes, colours = surface_axes(SurfacePanel(points, None, believed=False), [])
    assert colours.get_ylabel() == "height in mm"
    assert "not found" in axes.get_title()
    surface_axes(SurfacePanel(points[:0], points[:0, 0], believed=True), [])


# --- in a notebook ---


def test_a_result_in_a_notebook_is_short_and_escaped(placed: Ended, placed_pot: JobRecord) -> None:
    result = RunOutcome("refused", "<script>alert('x')</script>" + 500 * "y", placed.folder, placed.report)
    html = result._repr_html_()
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert len(html) < 3000
    assert "at most 0.6 mm" in html
    assert len(repr(result)) < 100
    assert str(result).startswith("refused: ")
    assert placed_pot.calibration is not None
    assert "χ²/dof" in placed_pot.calibration._repr_html_()
    assert len(repr(placed_pot.calibration)) < 100
