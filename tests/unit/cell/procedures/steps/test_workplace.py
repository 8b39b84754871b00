"""Where a job is done: what is stated of the arm."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.procedures.steps.workplace import CHANCE_SCATTER, Workplace

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
    [(None, 1.0), ((0.2, 0.5), 1.0), ((CHANCE_SCATTER - 0.05, 1.0), 1.0), ((2.0, 1.0), 2.0), ((0.5, 3.0), 3.0)],
)
def test_an_arm_scatters_as_configured_or_as_much_more_as_was_found(found: tuple[float, float] | None, times: float):
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
