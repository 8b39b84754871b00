"""How good the cell is today: series of figures of reports, their trends against closed forms, and what is due."""

import datetime as dt
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.base.storage import write_json
from cell.config.calibrations.store import save_calibration
from cell.procedures.calibrate.interim import MOVED
from cell.run.folder import new_run
from cell.run.health import DriftSeries, health
from tests.support import Typed
from tests.unit.cell.config.calibrations.test_store import made

MADE = dt.datetime(2026, 11, 1, 8, 0, 0).astimezone()
CALIBRATED = MADE.strftime("%Y-%m-%d %H:%M:%S")
DAY_S = 86_400.0
MAX_AGE_S = 30 * DAY_S


def job(root: Path, day: float, off: list[float] | None = None, shared: bool = False, **more: Any) -> str:
    """A job's report of this day, whose look at the board saw the head `off`, mm; `shared`: it went by one before."""
    folder = new_run(root)
    started = (MADE + dt.timedelta(days=day)).strftime("%Y-%m-%dT%H:%M:%S%z")
    arrival: dict[str, Any] = {"photographs": 2}
    if off is not None:
        arrival["interim"] = {"off_mm": off, "place_allowed_mm": 0.18}
    sweep = {"head_slipped_um": [30.0, -40.0], "laser_turned_mrad": 0.35, "laser_confirmed_mrad": 0.3}
    if shared:
        sweep["head_looked_s_ago"] = 40.0
    steps = [{"name": "drive_to_target", "result": arrival}, {"name": "laser_sweep", "result": sweep}]
    report = {
        "run": folder.name, "kind": "job", "outcome": "placed", "reason": "", "code": None, "started": started,
        "calibration_date": CALIBRATED, "steps": steps,
    } | more  # fmt: skip
    write_json(folder / "report.json", report)
    return folder.name


def series(values: list[list[float]], limit: float = 0.18) -> DriftSeries:
    return DriftSeries("head", "mm", np.arange(float(len(values))), np.array(values), limit)


def test_what_scatters_does_not_creep_and_its_mean_counts():
    rng = np.random.default_rng(4)
    for jobs in (5, 12):
        found = [series((0.03 * rng.normal(size=(jobs, 3)) + [0.05, 0.0, 0.0]).tolist()) for _ in range(500)]
        assert sum(one.a_day > 0.0 for one in found) <= 1
        assert max(one.now for one in found) < 0.16


def test_what_creeps_is_told_with_the_day_on_which_the_limit_is_reached():
    """0.01 mm a day from nothing, over nine days: 0.18 mm nine days later."""
    rng = np.random.default_rng(5)
    along = np.array([0.6, 0.8, 0.0])
    found = series([(0.01 * day * along + 1e-4 * rng.normal(size=3)).tolist() for day in range(10)])
    assert (found.a_day, found.now) == (pytest.approx(0.01, rel=0.02), pytest.approx(0.09, abs=0.001))
    assert found.days_left == pytest.approx(9.0, rel=0.05)
    assert series([[0.2, 0.0, 0.0]] * 6).days_left == 0.0
    assert series([[0.1, 0.0, 0.0]] * 6).days_left is None
    assert series([[0.2, 0.0, 0.0]] * 6, limit=0.21).days_left is None


def test_one_that_comes_back_reaches_the_limit_on_its_other_side():
    found = series([[0.10 - 0.01 * day] for day in range(8)])
    assert found.now == pytest.approx(0.03, abs=1e-6) and found.days_left == pytest.approx(21.0, rel=1e-6)


def test_four_jobs_make_no_trend_and_nor_do_five_of_one_morning():
    found = series([[0.01 * day, 0.0, 0.0] for day in range(4)])
    assert found.a_day == 0.0 and found.now == pytest.approx(0.02) and found.last == 0.03
    morning = series([[0.01 * job, 0.0, 0.0] for job in range(6)])
    assert morning.a_day > 0.0 and replace(morning, days=morning.days / 10.0).a_day == 0.0


def test_a_step_is_no_trend_and_counts_at_once():
    """Thirty jobs, of which the last three lie 0.3 mm off; and 0.15 mm for a long time, which does not go on."""
    rng = np.random.default_rng(6)
    bumped = series((0.01 * rng.normal(size=(30, 3)) + [[0.3 * (day >= 27), 0.0, 0.0] for day in range(30)]).tolist())
    assert bumped.a_day == 0.0 and bumped.now == pytest.approx(0.3, abs=0.03) and bumped.days_left == 0.0
    stays = series((0.01 * rng.normal(size=(30, 3)) + [[0.15 * (day >= 15), 0.0, 0.0] for day in range(30)]).tolist())
    assert stays.a_day == 0.0 and stays.now == pytest.approx(0.15, abs=0.03) and stays.days_left is None


def test_the_jobs_since_the_newest_calibration_count(tmp_path):
    job(tmp_path, -3.0, [9.0, 9.0, 9.0], calibration_date="2026-10-01 00:00:00")
    names = [job(tmp_path, day, [0.03, 0.04, 0.0]) for day in range(6)]
    job(tmp_path, 6.0)
    found = health(tmp_path, tmp_path / "calibrations", MAX_AGE_S, MADE + dt.timedelta(days=7))
    head, rail, laser = found.series
    assert (found.calibrated, found.jobs, found.unlooked, len(head.days)) == (CALIBRATED, 7, 1, 6)
    assert head.days.tolist() == pytest.approx([0, 1, 2, 3, 4, 5]) and head.now == pytest.approx(0.05)
    assert head.limit == 0.18 and [rail.limit, laser.limit] == pytest.approx([0.15, 0.7])
    assert rail.values[0].tolist() == pytest.approx([0.03, -0.04]) and rail.last == pytest.approx(0.05)
    assert laser.now == pytest.approx(0.05) and len(names) == 6
    assert found.days_left == pytest.approx(23.0) and found.due == "a calibration is due in 23.0 days, by its age"


def test_a_look_that_parts_share_counts_once(tmp_path):
    """Of a batch, only the first part looked; nobody forgot to."""
    job(tmp_path, 0.0, [0.0, 0.0, 0.0])
    for part in range(3):
        job(tmp_path, 0.001 * (part + 1), shared=True)
    found = health(tmp_path, tmp_path / "calibrations", MAX_AGE_S, MADE + dt.timedelta(days=1))
    assert (found.jobs, found.unlooked) == (4, 0)
    assert [len(one.days) for one in found.series] == [1, 1, 1]


def test_a_creeping_head_is_due_before_its_calibration_is_old(tmp_path):
    for day in range(10):
        job(tmp_path, day, [0.01 * day, 0.0, 0.0])
    found = health(tmp_path, tmp_path / "calibrations", MAX_AGE_S, MADE + dt.timedelta(days=9))
    assert found.due == "a calibration is due in 9.0 days: head, joints or board creeps 0.010 mm a day"


def test_what_was_refused_because_it_moved_is_due_now_until_a_job_passes_its_look_again(tmp_path):
    job(tmp_path, 0.0, [0.0, 0.0, 0.0])
    refusal = {"numbers": [{"name": MOVED, "value": 0.4}]}
    refused = job(tmp_path, 1.0, outcome="refused", refusal=refusal, steps=[])
    found = health(tmp_path, tmp_path / "calibrations", MAX_AGE_S, MADE + dt.timedelta(days=2))
    assert (found.moved, found.days_left) == (refused, 0.0)
    assert found.due == f"a calibration is due now: run {refused} was refused, for something has moved"
    job(tmp_path, 1.5, [0.0, 0.0, 0.0])
    found = health(tmp_path, tmp_path / "calibrations", MAX_AGE_S, MADE + dt.timedelta(days=2))
    assert (found.moved, found.due_now) == ("", False)


def test_after_a_new_calibration_the_jobs_before_it_count_no_more(tmp_path):
    name = job(tmp_path, 0.0, outcome="refused", refusal={"numbers": [{"name": MOVED, "value": 0.4}]}, steps=[])
    calibration = made()
    save_calibration(calibration, tmp_path / name / "calibration.json")
    newer = replace(calibration, made=(MADE + dt.timedelta(days=3)).timestamp())
    save_calibration(newer, tmp_path / "calibrations" / f"{newer.name}.json")
    found = health(tmp_path, tmp_path / "calibrations", MAX_AGE_S, MADE + dt.timedelta(days=4))
    assert (found.calibrated, found.jobs, found.moved) == (newer.date, 0, "")
    assert found.due == "a calibration is due in 29.0 days, by its age"


def test_the_tightest_job_sets_the_limit_and_another_cells_jobs_do_not_count(tmp_path):
    tight = {"off_mm": [0.1, 0.0, 0.0], "place_allowed_mm": 0.06}
    job(tmp_path, 0.0, steps=[{"name": "drive_to_target", "result": {"interim": tight}}])
    job(tmp_path, 1.0, [0.1, 0.0, 0.0])
    job(tmp_path, 0.5, [9.0, 0.0, 0.0], simulated=True, seed=4)
    found = health(tmp_path, tmp_path / "calibrations", MAX_AGE_S, MADE + dt.timedelta(days=2))
    assert found.series[0].limit == 0.06 and found.jobs == 2 and found.due_now


@pytest.mark.parametrize(
    "spoilt",
    [
        {"started": "yesterday"}, {"steps": [{"name": "drive_to_target", "result": {"interim": {}}}]},
        {"refusal": "no"}, {"calibration_date": 5},
        {"steps": [{"name": "laser_sweep", "result": {"laser_turned_mrad": "much"}}]},
    ],
)  # fmt: skip
def test_a_report_that_tells_too_little_is_left_out(tmp_path, spoilt: dict[str, Any]):
    job(tmp_path, 0.0, [0.0, 0.0, 0.0])
    job(tmp_path, 1.0, [0.0, 0.0, 0.0], **spoilt)
    assert health(tmp_path, tmp_path / "calibrations", MAX_AGE_S, MADE).jobs == 1


def test_what_is_beyond_its_limit_is_due_now_and_so_is_what_is_old(tmp_path):
    job(tmp_path, 0.0, [0.3, 0.0, 0.0])
    found = health(tmp_path, tmp_path / "calibrations", MAX_AGE_S, MADE)
    assert found.due == "a calibration is due now: head, joints or board is beyond its limit"
    old = health(tmp_path / "none", tmp_path / "calibrations", MAX_AGE_S, MADE)
    assert (old.calibrated, old.due) == ("", "no job has run yet: nothing is known")
    other = tmp_path / "other"
    job(other, 0.0, [0.0, 0.0, 0.0])
    aged = health(other, tmp_path / "calibrations", MAX_AGE_S, MADE + dt.timedelta(days=31))
    assert aged.due_now and aged.due == "a calibration is due now: it is 31 days old"


def test_a_protective_stop_since_is_named_and_what_is_no_job_is_left_out(tmp_path):
    name = job(tmp_path, 0.0, [0.0, 0.0, 0.0], outcome="faulted", code="arm.protective_stop", reason="arm: stopped")
    job(tmp_path, 1.0, [5.0, 5.0, 5.0], kind="verification")
    write_json(new_run(tmp_path) / "report.json", {"spoilt": True})
    found = health(tmp_path, tmp_path / "calibrations", MAX_AGE_S, MADE)
    assert found.shocks == ((name, "arm: stopped"),) and found.jobs == 1
    told = json.loads(json.dumps(found.as_dict()))
    assert told["shocks"] == [{"run": name, "reason": "arm: stopped"}]
    assert told["parts"][0]["values"] == [0.0] and told["parts"][0]["days_left"] is None


def test_the_command_shows_it_and_ends_with_1_when_a_calibration_is_due(here: Path, typed: Typed):
    code, out, _ = typed("health")
    assert (code, "no job has run yet" in out) == (0, True)
    job(here / "runs", 0.0, [0.3, 0.0, 0.0], outcome="faulted", code="arm.protective_stop", reason="arm: stopped")
    code, out, _ = typed("health")
    assert code == 1 and "parts may sit elsewhere: arm: stopped" in out and "is due now" in out
    assert "█" in out and "0.300" in out and "0.18" in out
    code, out, _ = typed("health", "--json")
    assert (code, json.loads(out)["days_left"]) == (1, 0.0)
