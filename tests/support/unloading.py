"""Loading and unloading: whole virtual jobs that take a part from its nest or its surface."""

from collections.abc import Callable
from pathlib import Path

from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.inversion import NominalSurface
from lab.bench.job.whole_job import JobRecord, run_whole_job
from tests.support.at_station import AtStation
from tests.support.report_runs import CONFIG, changed

SHIPPED, MESH = load_job("unload")
JOB = changed(SHIPPED, "scan", speed=2.0 * SHIPPED.scan.speed, frame_rate=20.0)
"""Swept twice as fast as shipped, with fewer pictures."""
Change = Callable[[VirtualCell], None]


def unloaded(placed_pot: JobRecord, change: Change, runs: Path | None = None) -> JobRecord:
    """The job in the world of `placed_pot`, with its calibration; `change` changes the cell before it."""
    nominal = NominalSurface.load(MESH, unit=JOB.surface.mesh_unit)
    return run_whole_job(
        CONFIG, JOB, nominal, placed_pot.seed, placed_pot.level, calibrated=placed_pot, runs=runs, changed=change
    )


def where_unloaded(record: JobRecord, folder: Path) -> AtStation:
    """A cell where `record` unloaded, with its part on its surface again."""
    return AtStation(record, folder, JOB, NominalSurface.load(MESH, unit=JOB.surface.mesh_unit))
