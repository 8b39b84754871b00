"""Real and simulated devices in one cell; simulated ones of another seed stand in for the hardware.

What is real is known to the cell by its measured states alone, as on hardware: nobody tells it that world's truth.
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from cell import Cell
from cell.config.job import job_path
from cell.devices.gate.gated import GatedCamera
from drivers.errors import CalibrationStale, DeadlineError
from sim_backends.clock import WorldClock
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.peers.rail.tmcl import TmclPeer
from tests.support.described_cells import changed, described, pose
from tests.support.wire.cells import SPEED, served
from tests.support.wire.cells import cell as command
from tests.support.wire.gige_bench import require_aravis

pytestmark = pytest.mark.wire

LOWER = 30.0
"""mm by which the real station's surface lies below where the job has it, its board where the job has it."""
STOPS = {"start": -3050.0, "staging": -1850.0, "target": -1050.0}
AIR = {
    "approach": {name: pose((x, 0.0, LOWER - 600.0), (0.0, 0.0, 0.0)) for name, x in STOPS.items()},
    "board": {"place_from_board": pose((142.43, 400.0, LOWER + 162.43), (-135.0, 0.0, -90.0))},
}
CAMERAS = "scan_camera,target_camera"
MIXES = (
    "scan_camera,laser", "scan_camera,claw", f"{CAMERAS},laser", f"{CAMERAS},vehicle", "scan_camera,rail,laser",
    f"{CAMERAS},arm,laser,claw", f"{CAMERAS},arm,vehicle,laser,claw", f"{CAMERAS},rail,vehicle,laser,claw",
    f"{CAMERAS},arm,rail,laser,claw", "claw",
)  # fmt: skip


def test_pictures_follow_a_real_rail_and_there_are_none_while_nobody_knows_where_it_is(tmp_path):
    clock = WorldClock()
    peer = TmclPeer(RailModel(RailParams(), np.random.default_rng(3)), clock)
    peer.start()
    config, _ = described(tmp_path, {"rail": {"url": f'"{peer.url}"'}})
    sim = "arm,vehicle,scan_camera,target_camera,laser,claw"
    try:
        with Cell.open(config, sim=sim, seed=7, only=("rail", "scan_camera")) as cell:
            rail, camera, world = cell.devices.rail, cell.devices.scan_camera, cell.simulated
            assert world is not None and cell.devices.following is not None
            assert "rail" not in world.facts["simulated"]
            rail.home().wait(30.0)
            rail.move_to(0.02).wait(10.0)
            camera.grab()
            told = world.truth()["rail"]
            assert told["carriage"] == pytest.approx(0.02 * told["scale"], abs=5e-5)
            assert isinstance(camera, GatedCamera)
            moving = rail.move_to(0.06)
            with pytest.raises(DeadlineError):
                camera.bare.grab(0.4)
            camera.grab()
            assert camera.statistics.errors["picture asked for again"] >= 1, "into the gap once more, then after it"
            moving.wait(10.0)
            figures = cell.devices.following.figures()
            assert figures["not_made"] >= 1
            assert "the rail" in figures["why_not"]
            assert figures["devices"]["rail"]["latency_ms"]["p50"] < 20.0
            assert figures["clocks_known_ms"] < 1.0
    finally:
        peer.stop()


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Calibrations of mixes with the same devices are shared."""
    made = tmp_path_factory.mktemp("mixes")
    described(made, job=AIR)
    return made


@pytest.mark.campaign
@pytest.mark.parametrize("sim", MIXES)
def test_the_job_ends_placed_with_any_mix_that_physics_allows(folder: Path, sim: str):
    placed(folder, sim)


@pytest.mark.campaign
def test_the_job_ends_placed_when_a_real_arm_sweeps_a_simulated_scan_head(folder: Path):
    text = changed(job_path("pot").read_text(encoding="utf-8"), {"scan": {"mode": '"arm"'}})
    (folder / "arm.toml").write_text(text, encoding="utf-8")
    placed(folder, "scan_camera,laser", "arm.toml")


@pytest.mark.campaign
def test_the_job_ends_placed_when_the_simulated_scan_camera_is_on_gige_vision(tmp_path):
    require_aravis()
    described(tmp_path, {"scan_camera": {"driver": '"gige"', "address": '"192.0.2.20"'}}, AIR)
    placed(tmp_path, "scan_camera,laser")


def placed(folder: Path, sim: str, job: str = "pot") -> None:
    """With a simulated scan camera the real station is out of the way; beside a real one it is where the job has it."""
    station = ("-j", "own.toml") if "scan_camera" in sim else ()
    at = ("--seed", "11", "--speed", os.environ.get("CELL_MIX_SPEED", SPEED))
    with served(folder, *at, *station), Cell.open(folder / "sim.toml", sim=sim, seed=3) as cell:
        try:
            cell.calibration()
        except CalibrationStale:
            cell.calibrate()
        serials = cell.calibration().identities
        outcome = cell.run(folder / job if job.endswith(".toml") else job, at_start=True)
    report = json.loads((outcome.folder / "report.json").read_text(encoding="utf-8"))
    print(sim, outcome, json.dumps({key: report[key] for key in ("following", "truth")}))
    assert outcome.outcome == "placed", outcome.reason
    if sim == "claw":
        assert report["truth"] is None, "nobody knows: the real claw has kept its part"
    else:
        assert report["truth"]["error_mm"]["d"]["mean"] < 0.30
    assert set(report["simulated"]) == set(sim.split(","))
    assert {name for name, serial in serials.items() if serial.startswith("simulated-")} == set(sim.split(",")) & set(
        serials
    )
    assert report["following"]["waited_ms"] is None or report["following"]["waited_ms"]["p50"] < 100.0


@pytest.mark.campaign
def test_a_calibration_of_a_mix_is_none_of_the_real_cell_nor_of_a_simulated_one(folder: Path):
    with served(folder, "--seed", "11"):
        real = command("run", "-c", "sim.toml", folder=folder)
        mixed = command("run", "-c", "sim.toml", "--sim", "scan_camera,rail", "--seed", "4", folder=folder)
    for done in (real, mixed):
        assert done.returncode == 1
        assert "holds no calibration of these devices" in done.stderr
