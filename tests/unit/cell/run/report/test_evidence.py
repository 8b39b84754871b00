"""A refusal leaves what it looked at, and a run is measured against its limits."""

import math
import re
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from cell.devices.simulated.direct import VirtualCell
from cell.measure.reconstruction.ply import read_cloud
from cell.run.report.figures import texture_words
from cell.run.report.page.make import make_page
from drivers.errors import Measured, RefusedError
from lab.bench.job.whole_job import JobRecord
from sim_backends.world.bodies.station import Station
from tests.support import report_runs
from tests.support.at_station import AtStation
from tests.support.report_runs import Ends, Make, read_strictly

REFUSALS: list[tuple[Make, str, str | None, bool, bool]] = [
    (report_runs.no_board, "drive_to_target", None, True, False),
    (report_runs.blurred_board, "drive_to_target", "board's dots off their places, RMS", True, False),
    (report_runs.few_points, "reconstruct", "points of the cloud", False, True),
    (report_runs.other_surface, "invert_pose", "points over the surface that fit it", False, False),
    (report_runs.too_strict, "invert_pose", "3σ in tolerances: translation along the z axis", False, False),
    (report_runs.no_contact, "place", None, True, False),
]


@pytest.mark.parametrize(("make", "step", "number", "frames", "cloud"), REFUSALS)
def test_a_refusal_leaves_what_it_looked_at(
    ends: Ends, make: Make, step: str, number: str | None, frames: bool, cloud: bool
):
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


def test_a_place_that_was_refused_is_shown_with_all_its_figures(ends: Ends):
    report = ends(report_runs.other_surface).report
    names = {row["name"] for row in report["refusal"]["numbers"]}
    assert {"fit, χ²/dof", "surface covered", "points off the surface, RMS"} <= names
    assert report["place_pose"] is None


def test_a_part_that_met_nothing_says_how_far_it_was_lowered(ends: Ends):
    (number,) = ends(report_runs.no_contact).report["refusal"]["numbers"]
    assert (number["name"], number["value"]) == ("reached without contact", pytest.approx(-1.0, abs=0.1))


def test_a_photograph_is_kept_before_it_is_looked_at(ends: Ends):
    run = ends(report_runs.no_board)
    # One from where the vehicle started, one after it drove on odometry: neither showed the board of the job.
    assert [Path(name).name[:9] for name in run.report["refusal"]["frames"]] == ["board-01-", "board-02-"]


def test_evidence_nearest_to_the_cause_stays():
    error = RefusedError("too little", Measured("points", 3, least=5)).showing(
        Measured("points", 4, least=5), Measured("rms", 0.1, "mm", most=0.3), seen={"frame": 1}
    )
    error.showing(seen={"frame": 2, "pose": 3})
    assert [(number.name, number.value) for number in error.numbers] == [("points", 3), ("rms", 0.1)]
    assert (error.seen, str(error)) == ({"frame": 1, "pose": 3}, "too little")


def test_a_fault_keeps_the_last_frames_and_every_fault_before_it(ends: Ends):
    run = ends(report_runs.faulted)
    report = read_strictly(run.folder / "report.json")
    assert report["refusal"] is None
    assert [(run.folder / name).is_file() for name in report["last_frames"]] == [True]
    first, last = report["faults"]
    assert (first["code"], first["step"], first["attempt"]) == ("camera.frames_lost", "laser_sweep", 1)
    assert (first["remedy"], last["remedy"]) == ("tried again", "ended the run")
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d{4}", first["at"])


def test_a_placed_run_measures_itself_against_its_limits(ends: Ends):
    report = ends(report_runs.placed).report
    rows, truth = {row["name"]: row for row in report["measured"]}, report["truth"]
    assert all(row["kept"] for row in rows.values())
    assert rows["place error, largest of 45 points"]["value"] == truth["error_mm"]["d"]["max"]
    assert rows["place error, largest of 45 points"]["limit"] == 0.6
    assert (rows["place error, stated 95 % bound"]["limit"], rows["contact depth"]["limit"]) == (0.6, 1.0)
    assert rows["surface covered"]["limit"] == 35.0
    assert 0.5 < rows["fit, χ²/dof"]["value"] < 2.0


def test_a_real_cell_has_its_own_figures(ends: Ends):
    report = ends(report_runs.real).report
    assert report["truth"] is None
    assert "; ".join(row["name"] for row in report["measured"][:5]) == (
        "place error, stated 95 % bound; contact depth; first touch, off what the scan says; fit, χ²/dof; "
        "surface covered"
    )


def test_a_surface_as_drawn_shows_no_waviness(ends: Ends):
    report = ends(report_runs.placed).report
    texture, row = report["scan"]["texture"], report["measured"][-2]
    assert (texture["sa_mm"], texture["sq_mm"], texture["sz_mm"]) == (None, None, None)
    assert texture["nesting_mm"] == 5.0 and 0.003 < texture["limit_mm"] < 0.01
    assert texture["area_mm2"] == pytest.approx(63.0 * 32.0, rel=0.1)
    assert row["name"].endswith("is less than") and row["value"] == pytest.approx(texture["limit_mm"], abs=1e-5)
    assert texture_words(report).startswith(f"no waviness told: {texture['reason']}; left: no waviness told: ")


def test_waves_on_the_scanned_surface_are_told(placed_pot: JobRecord, tmp_path):
    def waved(cell: VirtualCell) -> None:
        drawing = cell.world.scene.drawing
        station = replace(drawing.station, waviness=(0.06e-3, 0.015, 0.25 * math.pi))
        cell.world.remake(replace(cell.world.scene, drawing=replace(drawing, station=station)), Station.of(station))

    site = AtStation(placed_pot, tmp_path, changed=waved)
    site.do("laser_sweep", "reconstruct", "invert_pose")
    run = report_runs.placed(replace(placed_pot, results=site.made), tmp_path / "runs")
    (tmp_path / "cloud.ply").rename(run.folder / "cloud.ply")
    report = run.report
    texture, through = report["scan"]["texture"], 0.06 * 2.0 ** -((5.0 / 15.0) ** 2)
    assert texture["sq_mm"] == pytest.approx(through / math.sqrt(2.0), rel=0.03)
    assert texture["sz_mm"] == pytest.approx(2.0 * through, rel=0.25)  # the form bends so few waves
    assert [row["name"] for row in report["measured"][-2:]] == ["waviness of the surface, Sq", "waviness of left, Sq"]
    (left,) = report["scan"]["areas"]
    assert left["area_mm2"] == pytest.approx(30.0 * 30.0, rel=0.1)
    assert left["sq_mm"] == pytest.approx(through / math.sqrt(2.0), rel=0.25)  # two waves, less their form
    assert f"; left: waviness over 5 mm: Sa {left['sa_mm']:.4f} mm" in texture_words(report)
    assert f"Waviness over 5 mm: Sa {texture['sa_mm']:.4f} mm, Sq {texture['sq_mm']:.4f} mm" in make_page(run.folder)


def test_a_waviness_that_cannot_be_told_does_not_cost_the_report(placed_pot: JobRecord, tmp_path):
    broken = replace(placed_pot.results["reconstruct"], by_poses=None)
    record = replace(placed_pot, results={**placed_pot.results, "reconstruct": broken})
    report = report_runs.placed(record, tmp_path / "runs").report
    assert (report["outcome"], report["scan"]["texture"]) == ("placed", None)
    assert report["texture_missing"].startswith("TypeError: ") and texture_words(report) == ""
