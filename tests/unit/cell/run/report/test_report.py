"""What a run says at its end: the report is strict and documented, and keeps its contract."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.base.storage import strict, write_json
from cell.config.job import SwathSection
from drivers.errors import CellError
from lab.bench.job.whole_job import JobRecord
from tests.support import ROOT, report_runs
from tests.support.at_station import AtStation
from tests.support.report_runs import Ended, Ends, pot, read_strictly

DOCUMENT = ROOT / "docs" / "reference" / "report.md"


def test_no_number_that_is_none_comes_into_the_report(placed_pot: JobRecord, tmp_path):
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


def in_two_sweeps(placed_pot: JobRecord, folder: Path) -> Ended:
    """The middle of the pot in two sweeps side by side."""
    job, _ = pot(length=0.030, swath=(SwathSection(across="-4 mm"), SwathSection(across="4 mm")))
    site = AtStation(placed_pot, folder, job)
    site.do("laser_sweep", "reconstruct", "invert_pose", "place")
    return report_runs.placed(site.ended, folder / "runs")


def test_every_key_of_a_report_is_documented_and_every_documented_key_exists(
    ends: Ends, placed_pot: JobRecord, tmp_path
):
    made = (report_runs.placed, report_runs.too_strict, report_runs.faulted, report_runs.aborted)
    reports = [in_two_sweeps(placed_pot, tmp_path).report, *(ends(make).report for make in made)]
    found = set().union(*(keys(report) for report in reports))
    # What other places of the program add, each only where something out of the ordinary was asked for or went wrong.
    elsewhere = {
        "injected", "not_injected", "not_injected[].fault", "not_injected[].why", "until", "scripted", "resumed_from",
        "pace", "drive_to_target.shared", "laser_sweep.head_looked_s_ago",
        "next_item", "held.base_from_flange", "held.covariance",
        "frames_missing", "truth_missing", "picture_missing", "texture_missing", "part_mesh.file", "part_mesh.sha256",
        "place.mating.least_mm", "place.mating.median_mm", "place.mating.largest_mm", "place.mating.seen",
        "place.allowed_for.shift_mm", "place.allowed_for.turn_mrad", "place.allowed_for.parts",
        "pick.base_from_flange", "pick.sigma_mm", "pick.sigma_mrad", "set_down.contact", "set_down.depth_error_mm",
        "set_down.touch", "set_down.base_from_flange", "nest_error.translation_mm", "nest_error.rotation_mrad",
        "refusal.placed", "truth.seen_error.translation_mm", "truth.seen_error.rotation_mrad",
        *(f"verify.{key}" for key in (
            "off_mm", "unsure_mm", "shift_mm", "turn_mrad", "sigma_mm", "sigma_mrad", "points", "beside", "unseen",
            "before_mm", "came_mm", "came_mrad", "features", "features.own_aside_mm", "features.own_farther_mm",
            "features.own_higher_mm", "unlike", "unlike.at_mm", "unlike.gone", "unlike.mm2",
            "gap", "gap.least_mm", "gap.median_mm", "gap.largest_mm", "gap.seen",
            "flush", "flush.least_mm", "flush.median_mm", "flush.largest_mm", "flush.seen",
        )),
    }  # fmt: skip
    assert found - documented() == set()
    # What only devices that are simulated beside real ones have is compared where there are some.
    following = {key for key in documented() if key.startswith("following.")}
    parents = {key for key in documented() if any(other.startswith((f"{key}.", f"{key}[")) for other in found)}
    assert documented() - found - parents - following == elsewhere


def test_what_went_wrong_with_the_report_itself_is_told_in_it(placed_pot: JobRecord, tmp_path):
    run = report_runs.crippled(placed_pot, tmp_path / "runs")
    assert {"frames_missing", "truth_missing", "picture_missing"} <= set(run.report)
    assert not (run.folder / "picture.png").is_symlink(), "the half of one was left"
    assert run.report["outcome"] == "placed"


def test_the_report_keeps_its_contract(ends: Ends):
    report = read_strictly(ends(report_runs.placed).folder / "report.json")
    assert {"outcome", "seed", "level", "steps", "place_pose", "place_sigma", "assumed_noise", "truth"} <= set(report)
    assert all({"name", "state", "duration_s", "retries", "wall_s"} <= set(step) for step in report["steps"])
    truth = report["truth"]
    assert (truth["points"], set(truth["error_mm"])) == (45, {"x", "y", "z", "d"})
    assert {"mean", "p85"} <= set(truth["sensor_mm"])
    assert 0 < truth["bound_mm"] < 0.5
    assert truth["d_p95"] <= truth["error_mm"]["d"]["max"] + 1e-9
    assert (report["kind"], len(report["mesh"]["sha256"])) == ("job", 64)
    assert report["started"] < report["ended"]
