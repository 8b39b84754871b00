"""Where a job is done: what is stated of the arm, what is told of a sweep, and what of an earlier one is left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration.drift.reference_plate import Pointing
from cell.measure.reconstruction import Cloud
from cell.procedures.drive.station_check import require_unmoved
from cell.procedures.steps import reconstruct
from cell.procedures.steps.board_photo import photographed
from cell.procedures.steps.invert_pose import inverted
from cell.procedures.steps.workplace import CHANCE_SCATTER, PHOTO_RATE_HZ, Workplace
from cell.procedures.sweep.stored_sweep import FILE, SweepRecord
from drivers.errors import NotObservable, RefusedError
from lab.bench.job.whole_job import JobRecord, NoFrames
from tests.support.report_runs import changed, pot, with_few_lines, work_of

CONFIG = load_config(None)
JOB = load_job("pot")[0]
ARM = CONFIG.arm


def workplace(found: tuple[float, float] | None) -> Workplace:
    """One whose calibration found the arm's scatter to be so many times as configured: in place and in angle."""
    unknown = cast(Any, None)
    reference = found and SimpleNamespace(
        arm_translation=found[0] * ARM.repeatability, arm_rotation=found[1] * ARM.repeatability_angle
    )
    calibration = cast(Any, SimpleNamespace(scan=SimpleNamespace(reference=reference)))
    return Workplace(CONFIG, JOB, unknown, calibration, unknown, unknown, Path(), unknown)


def sigmas(covariance: np.ndarray) -> tuple[float, float]:
    """In place and in angle; the covariance has the same along every axis, and nothing beside them."""
    assert covariance.shape == (6, 6)
    np.testing.assert_array_equal(covariance, np.diag(np.repeat(np.diag(covariance)[[0, 3]], 3)))
    shift, turn = np.sqrt(np.diag(covariance)[[0, 3]])
    return float(shift), float(turn)


@pytest.mark.parametrize(
    ("found", "times"),
    [
        (None, 1.0),
        ((0.2, 0.5), 1.0),
        ((CHANCE_SCATTER - 0.05, 1.0), 1.0),
        ((2.0, 1.0), 2.0),
        ((0.5, 3.0), 3.0),
    ],
)
def test_an_arm_scatters_as_configured_or_as_much_more_as_was_found(
    found: tuple[float, float] | None, times: float
) -> None:
    here = workplace(found)
    over_the_place = (JOB.approach.target.se3() * ARM.vehicle_from_base.se3()).translation
    over_the_board = CONFIG.calibration.fine.base_from_board.se3().translation
    farther = 1.0 if times == 1.0 else float(np.linalg.norm(over_the_place) / np.linalg.norm(over_the_board))
    assert farther >= 1.0
    assert sigmas(here.repeatability) == pytest.approx(
        (farther * times * ARM.repeatability, times * ARM.repeatability_angle)
    )
    assert sigmas(here.kinematic) == pytest.approx(
        (farther * times * ARM.kinematic_sigma, times * ARM.kinematic_sigma_angle)
    )
    # While it stands nothing of that is felt anew.
    assert sigmas(here.settling) == pytest.approx((ARM.repeatability, ARM.repeatability_angle))
    assert bool(here.notes) == (times != 1.0)
    assert all(f"scattered {times:.1f} times as much" in note for note in here.notes)


# --- the steps after the sweep ---


def at_work(record: JobRecord, folder: Path, **place: object) -> Workplace:
    job, nominal = pot()
    cell = VirtualCell(CONFIG, record.seed, record.level)
    return work_of(cell, changed(job, "place", **place), nominal, record, NoFrames(), folder)


def test_every_look_at_the_board_is_taken_with_the_exposure_that_is_configured(
    placed_pot: JobRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Taken(Exception):
        """The camera was asked."""

    def photograph(count: int = 1) -> None:
        raise Taken

    here, fix, asked = at_work(placed_pot, tmp_path), placed_pot.results["board_photo"], []
    monkeypatch.setattr(here, "photograph", photograph)
    monkeypatch.setattr(here, "mover", SimpleNamespace(to=lambda *given: None))
    monkeypatch.setattr(here.devices.target_camera, "configure", lambda *given: asked.append(given))
    with pytest.raises(Taken):
        photographed(here, fix.base_from_board, lambda share, text: None)
    with pytest.raises(Taken):
        require_unmoved(here, fix, "before the sweep", lambda share, text: None)
    assert asked == [(CONFIG.target_camera.photo_exposure, PHOTO_RATE_HZ)] * 2


@pytest.mark.parametrize("doubts", [(), ("nobody looked where the laser points",)])
def test_where_the_place_is_known_too_little_what_was_noted_of_the_sweep_is_told(
    placed_pot: JobRecord, tmp_path: Path, doubts: tuple[str, ...]
) -> None:
    here, made = at_work(placed_pot, tmp_path, tolerance=0.05e-3), placed_pot.results
    sweep = replace(made["laser_sweep"], doubts=doubts)
    with pytest.raises(NotObservable) as caught:
        inverted(here, sweep, made["reconstruct"], made["board_photo"])
    assert ("Before: nobody looked where the laser points" in str(caught.value)) == bool(doubts)


def test_the_cloud_of_an_earlier_sweep_is_gone_whatever_becomes_of_this_one(
    placed_pot: JobRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*given: object) -> None:
        raise MemoryError("too many points")

    (tmp_path / "cloud.ply").write_text("of the sweep before")
    monkeypatch.setattr(reconstruct, "build_cloud", fails)
    with pytest.raises(MemoryError):
        reconstruct.reconstructed(at_work(placed_pot, tmp_path), placed_pot.results["laser_sweep"])
    assert not (tmp_path / "cloud.ply").exists()


def test_the_cloud_is_built_with_the_laser_where_it_pointed(
    placed_pot: JobRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, sweep, given = at_work(placed_pot, tmp_path), placed_pot.results["laser_sweep"], []
    monkeypatch.setattr(reconstruct, "reconstruct", lambda sweep, head, *_, **__: given.append(head))
    turned, head = Pointing(1e-3, 1e-5, 0.0), here.calibration.scan
    for pointing in (None, turned):
        reconstruct.reconstructed(here, replace(sweep, pointing=pointing))
    expected = head.pointed(turned, CONFIG.laser.exit_point).geometry().light_plane
    assert given[0] is head
    np.testing.assert_array_equal(given[1].geometry().light_plane.normal, expected.normal)
    assert not np.allclose(expected.normal, head.geometry().light_plane.normal, atol=1e-4)


def test_a_sweep_is_kept_and_its_cloud_shown_also_where_it_is_refused(placed_pot: JobRecord, tmp_path: Path) -> None:
    assert placed_pot.folder is not None and (placed_pot.folder / FILE).is_file()
    here, told = at_work(placed_pot, tmp_path), []
    here.devices.gate.listener = cast(Any, SimpleNamespace(reading=lambda device, reading: told.append(device)))
    few = with_few_lines(placed_pot, 2).results["laser_sweep"]
    for sweep in (placed_pot.results["laser_sweep"], few):
        context = cast(Any, SimpleNamespace(made={SweepRecord: sweep}.get))
        if sweep is few:
            with pytest.raises(RefusedError) as caught:
                reconstruct.STEP.work(here, context)
            assert isinstance(caught.value.seen["cloud"], Cloud)
        else:
            reconstruct.STEP.work(here, context)
    assert told == ["scan_camera"]
