"""A laser that turned: what a verification's board confirms is kept for jobs, what the plate alone tells is stated."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.apps.cli.app import app
from cell.config.calibrations.store import CellCalibration, read_calibration, save_calibration
from cell.config.cell_config import CellConfig, load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration.drift.reference_plate import ConfirmedTurn, Pointing
from cell.measure.inversion import NominalSurface
from cell.procedures.arm.moves import Mover
from cell.procedures.calibrate.verification import CheckObservations, Verification, collect_verification, keep_confirmed
from drivers.errors import RefusedError
from lab.bench.job.whole_job import JobRecord, run_whole_job
from sim_backends.world import levels
from sim_backends.world.scene import draw

CONFIG = load_config(None)
JOB, MESH = load_job("pot")
STOOD_S = 3600.0
LEVEL = "nominal+laser_pointing"
PLATE_RAD = 0.095e-3
"""What 20 µm of the plate are, one standard deviation."""
TURN = ConfirmedTurn(plate=0.50e-3, turn=0.54e-3, sigma=0.03e-3, made=1e9)


@pytest.mark.parametrize("further", [0.0, 0.08e-3, -0.05e-3])
def test_what_the_board_has_confirmed_is_not_uncertain_any_more(further: float):
    seen = Pointing(TURN.plate + further, PLATE_RAD)
    alone, known = seen.stated, TURN.since(seen).stated
    assert alone.sigma > abs(seen.turn)
    assert known.turn == pytest.approx(TURN.turn + further)
    assert (known.sigma, known.open) == (pytest.approx(np.hypot(PLATE_RAD, TURN.sigma)), 0.0)


def test_a_plate_that_is_knocked_after_it_was_confirmed_is_not_believed():
    known = TURN.since(Pointing(TURN.plate + 0.4e-3, PLATE_RAD)).stated
    assert known.sigma > 0.4e-3
    assert "of which +0.540 mrad were seen on a board" in known.words


def test_it_is_stored_and_what_is_no_turn_is_not_read():
    assert ConfirmedTurn.read(json.loads(json.dumps(vars(TURN)))) == TURN
    assert ConfirmedTurn.read(None) is None
    for spoilt in ({"sigma": 0.0}, {"turn": float("nan")}):
        with pytest.raises(ValueError, match="confirmed turn"):
            ConfirmedTurn.read(vars(TURN) | spoilt)


def collected(
    calibration: CellCalibration, seed: int, config: CellConfig = CONFIG, check: Callable[[], None] = lambda: None
) -> CheckObservations:
    """What a verification sees of the cell of `seed` after it has stood for an hour."""
    cell = VirtualCell(config, seed, LEVEL)
    cell.world.stand(STOOD_S)
    cell.devices.interlocks.work_with(calibration.configuration)
    cell.devices.vehicle.brake()
    mover = Mover(cell.devices.arm, cell.clock, config, JOB)
    given = config, cell.devices, mover, calibration, check, lambda f, t: None, lambda what, frame: None
    return collect_verification(*given)


@pytest.fixture
def turned(placed_pot: JobRecord, monkeypatch) -> tuple[Verification, float]:
    """A verification of a cell whose laser has turned by half a milliradian, and by how much, rad."""
    monkeypatch.setattr(levels, "ALONE", replace(levels.ALONE, laser_pointing=80e-6))
    true = abs(draw(placed_pot.seed, LEVEL).workshop.pointing) * (1 - np.exp(-STOOD_S / levels.WARMING_S))
    seen = collected(placed_pot.calibration, placed_pot.seed)
    return Verification.of(placed_pot.calibration, JOB, seen), float(true)


def test_a_short_and_slow_rail_has_room_to_gain_its_speed(placed_pot: JobRecord):
    rail = CONFIG.rail.model_copy(update={"travel": (0.0, 0.04), "max_speed": 0.01, "acceleration": 0.02})
    checks = iter([None, None])

    def until_swept() -> None:
        if next(checks, "swept"):
            raise RefusedError("swept")

    with pytest.raises(RefusedError, match="swept"):
        collected(placed_pot.calibration, placed_pot.seed, CONFIG.model_copy(update={"rail": rail}), until_swept)


def test_a_verification_keeps_the_turn_for_jobs_and_takes_it_back_when_the_plate_was_knocked(
    turned: tuple[Verification, float], placed_pot: JobRecord, here: Path
):
    found, true = turned
    folder, path = here / "calibrations", here / "calibrations" / f"{placed_pot.calibration.name}.json"
    save_calibration(placed_pot.calibration, path)
    kept = keep_confirmed(folder, placed_pot.calibration, found)
    assert found.good
    assert abs(abs(kept.turn) - true) < 3 * kept.sigma < 0.15e-3
    again = read_calibration(path)
    assert again.scan.confirmed == kept
    assert again.hash() != placed_pot.calibration.hash()
    (row,) = json.loads(CliRunner().invoke(app, ["calibrate", "list", "--json"]).stdout)
    shown = json.loads(CliRunner().invoke(app, ["calibrate", "show", row["name"], "--json"]).stdout)
    assert row["laser_since"] == shown["laser_since"] == kept.summary()
    assert "verified" in CliRunner().invoke(app, ["calibrate", "list"]).stdout

    plate = found.witness.plate
    knocked = replace(found, witness=replace(found.witness, plate=replace(plate, turn=plate.turn + 0.8e-3)))
    assert keep_confirmed(folder, again, knocked) is None
    assert read_calibration(path).scan.confirmed is None


@pytest.mark.usefixtures("here")
def test_a_calibration_that_is_not_there_is_not_shown():
    assert json.loads(CliRunner().invoke(app, ["calibrate", "list", "--json"]).stdout) == []
    assert CliRunner().invoke(app, ["calibrate", "show", "nobody's"]).exit_code != 0


@pytest.mark.campaign
def test_a_job_that_was_refused_for_the_turn_goes_on_once_it_is_confirmed(
    turned: tuple[Verification, float], placed_pot: JobRecord, tmp_path
):
    nominal = NominalSurface.load(MESH, unit=JOB.surface.mesh_unit)

    def run(record: JobRecord) -> JobRecord:
        return run_whole_job(CONFIG, JOB, nominal, placed_pot.seed, LEVEL, calibrated=record, stood=STOOD_S)

    before = run(placed_pot)
    assert before.outcome == "refused"
    assert "laser points" in before.reason
    keep_confirmed(tmp_path, placed_pot.calibration, turned[0])
    known = read_calibration(tmp_path / f"{placed_pot.calibration.name}.json")
    after = run(replace(placed_pot, calibration=known))
    assert (after.outcome, after.reason) == ("placed", "")
    assert after.results["invert_pose"].sigma[2] < 0.15e-3
