"""How late a simulated camera's stamps come, and its shutter, from sweeps over the fine board."""

from dataclasses import replace

import numpy as np
import pytest

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration.drift.timing import StampTiming
from cell.measure.inversion import NominalSurface
from cell.procedures.arm.moves import Mover
from cell.procedures.calibrate.timing import collect_timing, look_at_shutter
from cell.procedures.steps.laser_sweep import times_known
from drivers.errors import RefusedError
from lab.bench.job.whole_job import JobRecord, run_whole_job
from sim_backends.world import scene

CONFIG = load_config(None)


def test_a_calibration_has_looked_at_the_shutter(placed_pot: JobRecord):
    shutter = placed_pot.calibration.scan.shutter
    assert abs(shutter.readout) < 5 * shutter.sigma < 0.25e-3
    assert times_known(placed_pot.calibration.scan, CONFIG) == (None, ())


def test_a_calibration_of_a_cell_with_a_rolling_shutter_is_refused(placed_pot: JobRecord):
    made = placed_pot.calibration
    cell = VirtualCell(CONFIG, 2, "nominal+rolling_shutter")
    cell.devices.vehicle.brake()
    mover = Mover(cell.devices.arm, cell.clock, CONFIG, None)
    with pytest.raises(RefusedError, match=r"rolling shutter: its last row is exposed (9\.9|10\.0|10\.1) ms after"):
        look_at_shutter(CONFIG, cell.devices, mover, made, lambda: None, lambda what, frame: None)


def test_a_shutter_that_could_not_be_looked_at_is_a_note_and_the_calibration_holds(placed_pot: JobRecord):
    made = placed_pot.calibration
    spoilt = replace(made, scan=replace(made.scan, shutter=None))
    short = CONFIG.model_copy(update={"rail": CONFIG.rail.model_copy(update={"travel": (0.04, 0.055)})})
    cell = VirtualCell(CONFIG, 2)
    mover = Mover(cell.devices.arm, cell.clock, CONFIG, None)
    seen = look_at_shutter(short, cell.devices, mover, spoilt, lambda: None, lambda what, frame: None)
    assert seen.scan.shutter is None
    assert "whether the scan camera has a rolling shutter was not seen: the fine board stays" in seen.scan.notes[-1]


def measured(made: CellCalibration, seed: int, level: str) -> StampTiming:
    """What the simulated cell of `seed` finds."""
    cell = VirtualCell(CONFIG, seed, level)
    cell.devices.interlocks.work_with(made.configuration)
    cell.devices.vehicle.brake()
    mover = Mover(cell.devices.arm, cell.clock, CONFIG, load_job("pot")[0])
    return collect_timing(CONFIG, cell.devices, mover, made, lambda: None, lambda f, t: None, lambda what, frame: None)


@pytest.mark.campaign
def test_ten_simulated_cells_know_their_lateness(monkeypatch):
    """Two milliseconds late each; the eleventh has a rolling shutter."""
    drawn = scene._clock
    monkeypatch.setattr(scene, "_clock", lambda *given: replace(drawn(*given), latency=2e-3))
    job, mesh = load_job("pot")
    nominal, off = NominalSurface.load(mesh, unit=job.surface.mesh_unit), []
    for seed in range(1, 11):
        record = run_whole_job(CONFIG, job, nominal, seed, "nominal")
        found = measured(record.calibration, seed, "nominal")
        assert found.sigma <= 0.2e-3
        off.append((found.late - 2e-3) / found.sigma)
    assert np.abs(off).max() < 3.5
    with pytest.raises(RefusedError, match="rolling shutter"):
        measured(record.calibration, 10, "nominal+rolling_shutter")
