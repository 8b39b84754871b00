"""What a page shows of the scanned surface, and why it is not compared with the drawn one."""

from __future__ import annotations

import base64
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.procedures.steps.reconstruct import Reconstruction
from cell.run.report.page.surface import MOST_POINTS, surface_view
from drivers.errors import CellError
from lab.bench.job.whole_job import JobRecord


def report(folder: Path) -> dict[str, Any]:
    told: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return told


def test_the_cloud_keeps_its_size_and_is_coloured_by_its_deviation(folder: Path, placed_pot: JobRecord) -> None:
    view = surface_view(folder, report(folder))
    made = placed_pot.results["reconstruct"]
    assert isinstance(made, Reconstruction)
    assert view is not None and view.compared
    assert view.map.startswith(b"\x89PNG")
    assert (view.cloud["count"], view.cloud["total"]) == (MOST_POINTS, made.cloud.size)
    # A third of the tolerance, 0.6 mm; red is above.
    assert (view.cloud["from"], view.cloud["to"]) == pytest.approx((-0.2, 0.2))
    assert view.stops[0] == "rgb(5,48,97)" and view.stops[-1] == "rgb(144,13,38)"
    # What is drawn has the measured cloud's size: distances do not depend on where it is seen from.
    shown = view.cloud["step"] * np.frombuffer(base64.b64decode(view.cloud["points"]), "<i2").reshape(-1, 3)
    measured = 1e3 * made.cloud.points[made.cloud.valid]
    spread = [np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))) for points in (shown, measured)]
    assert spread[0] == pytest.approx(spread[1], rel=0.01)


def test_a_surface_that_is_another_by_now_is_not_compared_with(folder: Path, tmp_path: Path) -> None:
    told = report(folder)
    told["mesh"]["sha256"] = 64 * "0"
    view = surface_view(folder, told)
    assert view is not None and not view.compared
    assert "pot.ply was changed since the run" in view.why
    told["place_pose"] = None
    view = surface_view(folder, told)
    assert view is not None and "did not find the surface's place" in view.why


def test_a_run_without_a_cloud_shows_none_and_a_spoilt_one_is_named(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / folder.name
    shutil.copytree(folder, run)
    (run / "cloud.ply").write_bytes(b"ply\n")
    with pytest.raises(CellError, match="is no cloud of this program"):
        surface_view(run, report(run))
    (run / "cloud.ply").unlink()
    assert surface_view(run, report(run)) is None
