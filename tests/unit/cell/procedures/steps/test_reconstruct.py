"""The cloud of a job: no earlier one is taken for it, and what was refused is shown."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.measure.calibration import ScanCalibration
from cell.measure.calibration.drift.reference_plate import Pointing
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.steps import reconstruct
from cell.procedures.sweep.stored_sweep import FILE, SweepRecord
from drivers.errors import RefusedError
from lab.bench.job.whole_job import JobRecord
from tests.support.at_station import Station
from tests.support.report_runs import with_few_lines

CONFIG = load_config(None)


def test_the_cloud_of_an_earlier_sweep_is_gone_whatever_becomes_of_this_one(
    placed_pot: JobRecord, station: Station, tmp_path, monkeypatch
):
    def fails(*given: object) -> None:
        raise MemoryError("too many points")

    (tmp_path / "cloud.ply").write_text("of the sweep before")
    monkeypatch.setattr(reconstruct, "build_cloud", fails)
    with pytest.raises(MemoryError):
        reconstruct.reconstructed(station(folded=False).work, placed_pot.results["laser_sweep"])
    assert not (tmp_path / "cloud.ply").exists()


def test_the_cloud_is_built_with_the_laser_where_it_pointed(placed_pot: JobRecord, station: Station, monkeypatch):
    workplace, sweep, given = station(folded=False).work, placed_pot.results["laser_sweep"], []
    monkeypatch.setattr(ScanCalibration, "variants", lambda head: given.append(head) or ())
    turned, head = Pointing(1e-3, 1e-5, 0.0), workplace.calibration.scan
    for pointing in (None, turned):
        reconstruct.reconstructed(workplace, replace(sweep, pointing=pointing))
    expected = head.pointed(turned, CONFIG.laser.exit_point).geometry().light_plane
    assert given[0] is head
    np.testing.assert_array_equal(given[1].geometry().light_plane.normal, expected.normal)
    assert not np.allclose(expected.normal, head.geometry().light_plane.normal, atol=1e-4)


def test_a_sweep_is_kept_and_its_cloud_shown_also_where_it_is_refused(placed_pot: JobRecord, station: Station):
    assert placed_pot.folder is not None and (placed_pot.folder / FILE).is_file()
    workplace, told = station(folded=False).work, []
    workplace.devices.gate.listener = cast(Any, SimpleNamespace(reading=lambda device, reading: told.append(device)))
    few = with_few_lines(placed_pot, 1).results["laser_sweep"]
    for sweep in (placed_pot.results["laser_sweep"], few):
        context = cast(Any, SimpleNamespace(made={SweepRecord: sweep}.get))
        if sweep is few:
            with pytest.raises(RefusedError) as caught:
                reconstruct.STEP.work(workplace, context)
            assert isinstance(caught.value.seen["cloud"], Cloud)
        else:
            reconstruct.STEP.work(workplace, context)
    assert told == ["scan_camera"]
