"""A run's folder for the tests of its page."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from cell.measure.reconstruction.ply import write_cloud
from cell.procedures.steps.reconstruct import Reconstruction
from cell.run.files.folder import write_json
from lab.bench.job.whole_job import JobRecord
from statemachine.journal import Journal
from tests.support import report_runs
from tests.support.report_runs import Ends, pot


@pytest.fixture(scope="module")
def folder(placed_pot: JobRecord, ends: Ends, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A placed run with what a whole run leaves: cloud, job and journal."""
    folder = tmp_path_factory.mktemp("page") / ends(report_runs.placed).folder.name
    shutil.copytree(ends(report_runs.placed).folder, folder)
    made = placed_pot.results["reconstruct"]
    assert isinstance(made, Reconstruction)
    write_cloud(folder / "cloud.ply", made.cloud)
    write_json(folder / "job.json", pot()[0].model_dump(mode="json"))
    journal = Journal(folder, folder.name, {"clock": "virtual"})
    for name, attempt, error in (("laser_sweep", 1, "frames were lost"), ("laser_sweep", 2, None)):
        journal.step_ended(journal.step_started(name, attempt), 2.0 * attempt, {}, error)
    journal.close()
    return folder
