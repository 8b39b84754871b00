"""The whole job on the simulated cell, as an engineer runs it: placed, aborted, killed, faulted, refused."""

import json
import os
import shutil
import signal
import sqlite3
import time
from pathlib import Path

import pytest
from can.io.canutils import CanutilsLogReader

from cell.config.cell_config import default_toml
from cell.run.record.reading import as_candump, information
from drivers.vehicle.agilex_link import load_database
from tests.support import Typed
from tests.support.described_cells import LEAN, changed
from tests.support.wire.cells import Supervised, assert_safe, served, started, wait_for_step

pytestmark = pytest.mark.wire


@pytest.fixture
def lean(place: Path) -> str:
    """The name of a configuration in `place` whose runs leave their report and journal alone."""
    (place / "lean.toml").write_text(changed(default_toml(), LEAN), encoding="utf-8")
    return "lean.toml"


def test_the_supervisor_script_of_the_readme_runs_as_printed(supervised: Supervised):
    assert "mean D" in supervised.printed


def test_a_run_over_the_wires_places_the_part_within_the_nominal_bound_and_ends_safe(supervised: Supervised):
    placed = supervised.report
    assert placed["outcome"] == "placed"
    assert placed["truth"]["error_mm"]["d"]["mean"] <= 0.60
    assert placed["truth"]["sensor_mm"]["p85"] <= 0.15
    end = placed["end_state"]
    assert not end["laser_on"] and end["vehicle"]["braked"] and not end["arm"]["moving"]
    assert not end["part"]["held"]


def test_the_run_folder_holds_everything(supervised: Supervised):
    folder = supervised.folder / "runs" / supervised.report["run"]
    names = {path.name for path in folder.iterdir()}
    assert {"report.json", "picture.png", "cloud.ply", "journal.sqlite", "frames", "configuration.json", "job.json",
            "calibration.json"} <= names  # fmt: skip
    assert len(list((folder / "frames").glob("stripe-*.png"))) > 50
    base = sqlite3.connect(folder / "journal.sqlite")
    done = [name for (name,) in base.execute("SELECT name FROM steps WHERE state = 'done' ORDER BY id")]
    assert done == [step["name"] for step in supervised.report["steps"]]


def test_the_record_holds_what_passed_on_the_wires(supervised: Supervised, tmp_path):
    record = supervised.folder / "runs" / supervised.report["run"] / "record.mcap"
    told = information(record)
    messages = {channel["topic"]: channel["messages"] for channel in told["channels"]}
    assert told["whole"] and told["dropped"] == {}
    assert min(messages[topic] for topic in ("/vehicle/can", "/rail/serial", "/arm/rtde")) > 500
    # A simulated cell runs three times as fast as the wall, and so do its wires.
    assert told["cpu_s"] < 0.09 * told["span_s"]
    as_candump(record, tmp_path / "can.log")
    with CanutilsLogReader(tmp_path / "can.log") as log:
        frames = list(log)
    names = {message.frame_id: message.name for message in load_database().messages}
    assert "MotionCommand" in {names.get(frame.arbitration_id) for frame in frames if not frame.is_rx}
    assert "SystemState" in {names.get(frame.arbitration_id) for frame in frames if frame.is_rx}


def test_ctrl_c_in_the_sweep_ends_safe_with_130_and_uncalibrated_it_is_refused(
    place: Path, lean: str, tmp_path, typed: Typed
):
    with served(place, "-c", lean, "--seed", "3") as endpoints:
        # No calibration lies beside this copy.
        shutil.copy(place / "sim.toml", tmp_path)
        code, _, error = typed("run", "-c", str(tmp_path / "sim.toml"))
        assert (code, "calibrat" in error) == (1, True), error
        with started("run", "-c", "sim.toml", "--at-start", "--json", folder=place) as run:
            wait_for_step(place, "laser_sweep", run)
            os.kill(run.pid, signal.SIGINT)
            out, err = run.communicate(timeout=30)
        assert run.returncode == 130, err
        report = json.loads(out)
        assert report["outcome"] == "aborted"
        assert "keyboard" in report["reason"]
        assert "Traceback" not in err
        assert_safe(endpoints)


def test_a_killed_simulation_is_reported_within_ten_seconds(place: Path, lean: str):
    with started("dry-run", "-c", lean, "--seed", "3", "--json", folder=place) as run:
        wait_for_step(place, "drive_to_target", run)
        children = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
        world = next(pid for pid in children if b"sim_backends" in Path(f"/proc/{pid}/cmdline").read_bytes())
        os.kill(int(world), signal.SIGKILL)
        killed = time.monotonic()
        out, err = run.communicate(timeout=30)
        took = time.monotonic() - killed
    assert run.returncode == 1
    assert took < 10
    assert "Traceback" not in err
    report = json.loads(out)
    assert report["outcome"] == "faulted"
    assert any(name in report["reason"] for name in ("arm", "camera", "rail", "vehicle"))
    for pid in children:
        assert not Path(f"/proc/{pid}").exists()


@pytest.mark.campaign
def test_two_dry_runs_at_once_do_not_disturb_each_other(place: Path):
    again = ("dry-run", "--seed", "3", "--until", "board_photo", "--json")
    with started(*again, folder=place) as first, started(*again, folder=place) as second:
        texts = [run.communicate(timeout=240) for run in (first, second)]
    for (out, err), run in zip(texts, (first, second), strict=True):
        assert run.returncode == 0, err
        assert json.loads(out)["outcome"] == "done"
