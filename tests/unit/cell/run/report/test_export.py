"""A run's cloud leaves for other programs with every point where it was measured, and its deviations where known."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cell.base.storage import write_json
from cell.measure.reconstruction.ply import read_cloud, write_cloud
from cell.run.report.export import SUFFIXES, export_run
from drivers.errors import ConfigError
from lab.bench.job.whole_job import JobRecord
from tests.support import report_runs
from tests.support.report_runs import Ends


@pytest.fixture
def folder(placed_pot: JobRecord, ends: Ends, tmp_path) -> Path:
    shutil.copy(ends(report_runs.placed).folder / "report.json", tmp_path)
    write_cloud(tmp_path / "cloud.ply", placed_pot.results["reconstruct"].cloud)
    return tmp_path


def test_points_and_deviations_are_those_of_the_run(folder: Path):
    stored = read_cloud(folder / "cloud.ply").points
    for kind in ("ply", "mesh", "stl"):
        out = folder / f"out-{kind}{SUFFIXES[kind]}"
        told = export_run(folder, kind, out, None, 1e-4)
        written = trimesh.load(out, process=False)
        assert written.bounds == pytest.approx(np.array([stored.min(axis=0), stored.max(axis=0)]), abs=1e-4)
        assert told["points"] == len(stored)
        assert kind == "ply" or len(written.faces) == told["triangles"]
        # By the pose that the run found, the points lie on the drawn surface.
        assert abs(told["deviation_mm"]["mean"]) < told["deviation_mm"]["rms"] < told["deviation_mm"]["p95"] < 0.2


def test_without_a_place_pose_there_is_no_deviation_and_an_unknown_job_is_asked_for(folder: Path):
    report = json.loads((folder / "report.json").read_text())
    del report["sha256"]
    write_json(folder / "report.json", {**report, "place_pose": None})
    assert "deviation_mm" not in export_run(folder, "ply", folder / "out.ply", None, 1e-4)
    for changed in ({"job_file": "gone"}, {"job_hash": "that of another surface"}):
        write_json(folder / "report.json", {**report, **changed})
        with pytest.raises(ConfigError, match="name the run's job file with --job"):
            export_run(folder, "ply", folder / "out.ply", None, 1e-4)
