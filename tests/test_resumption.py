"""What an earlier run left is trusted only while its job, its calibration and its board are what they were."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cell.config import load_config
from cell.geometry.poses import from_parts
from cell.job import load_job
from cell.run.resumption import UnfinishedRun, job_hash
from cell.steps.photograph import BoardFix
from cell.steps.stored_sweep import FILE, StoredSweep
from cell.steps.sweep_record import SweepRecord
from drivers.errors import CalibrationStale, ConfigError
from statemachine.journal import Journal
from tests.test_stored_calibration import made

SIGMA = np.diag([1e-5**2] * 3 + [5e-5**2] * 3)
SEEN = pin.SE3(np.eye(3), np.array([0.9, 0.1, 0.2]))


def fix(moved: pin.SE3) -> BoardFix:
    return BoardFix(SEEN * moved, SIGMA, 0.05, 0.1, ())


def stored(folder: Path) -> StoredSweep:
    return StoredSweep(folder, SweepRecord(()), SEEN, SIGMA)


def test_a_sweep_holds_where_the_board_stands_as_it_stood(tmp_path: Path) -> None:
    assert stored(tmp_path).confirmed_by(fix(from_parts((1e-5, -1e-5, 0.0)))).swaths == ()


@pytest.mark.parametrize("shift", [(3e-4, 0.0, 0.0), (0.0, 0.0, -3e-4)])
def test_a_board_that_has_moved_takes_its_sweep_with_it(tmp_path: Path, shift: tuple[float, float, float]) -> None:
    with pytest.raises(CalibrationStale, match=r"the board has moved by 0\.30 mm"):
        stored(tmp_path).confirmed_by(fix(from_parts(shift)))


def test_a_board_that_was_turned_takes_its_sweep_with_it(tmp_path: Path) -> None:
    turned = pin.SE3(pin.exp3(np.array([0.0, 0.0, 2e-3])), np.zeros(3))
    with pytest.raises(CalibrationStale, match="the board has moved"):
        stored(tmp_path).confirmed_by(fix(turned))


def job_file(folder: Path) -> Path:
    """The shipped job as files of one's own."""
    job, mesh = load_job("pot")
    shutil.copy(mesh, folder / job.surface.mesh)
    return Path(shutil.copy(mesh.parent / "pot.toml", folder / "mine.toml"))


def cut_short(folder: Path, job: Path, **info: object) -> None:
    """The journal of a run of this job whose process died."""
    Journal(folder, folder.name, {"job_file": str(job), "job_hash": job_hash(job), "simulated": False, **info}).close()


def test_a_run_that_was_cut_short_is_found_with_its_job(tmp_path: Path) -> None:
    job = job_file(tmp_path)
    cut_short(tmp_path, job)
    assert UnfinishedRun.find(tmp_path).job == str(job)


def test_a_job_or_a_mesh_that_was_changed_is_not_resumed(tmp_path: Path) -> None:
    job = job_file(tmp_path)
    cut_short(tmp_path, job)
    text = job.read_text()
    job.write_text(text.replace('speed = "15 mm/s"', 'speed = "16 mm/s"') + "\n")
    with pytest.raises(ConfigError, match="was changed since run"):
        UnfinishedRun.find(tmp_path)
    job.write_text(text)
    UnfinishedRun.find(tmp_path)
    mesh = tmp_path / load_job(job)[0].surface.mesh
    mesh.write_bytes(mesh.read_bytes() + b"\0")
    with pytest.raises(ConfigError, match="was changed since run"):
        UnfinishedRun.find(tmp_path)


@pytest.mark.parametrize("other", ["calibration", "configuration"])
def test_a_sweep_under_another_calibration_or_configuration_is_not_used(tmp_path: Path, other: str) -> None:
    calibration, config = made(), load_config(None)
    hashes = {"calibration_hash": calibration.hash(), "configuration_hash": config.calibration_hash()}
    job = job_file(tmp_path)
    cut_short(tmp_path, job, **{**hashes, f"{other}_hash": "0123456789abcdef"})
    (tmp_path / FILE).touch()
    sweep, why = UnfinishedRun.find(tmp_path).sweep(load_job(job)[0], config, calibration)
    assert sweep is None
    assert why.startswith(f"the {other} was changed since run")
