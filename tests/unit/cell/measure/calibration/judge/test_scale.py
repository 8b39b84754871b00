"""A board that was printed larger or smaller than its name says is told by the arm's ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cell.measure.calibration import TargetObservation
from cell.measure.calibration.solve.joint import Joint
from cell.measure.calibration.solve.results import adjust_target
from cell.measure.geometry.poses import from_parts
from drivers.errors import RefusedError
from tests.unit.cell.measure.calibration.solve.test_results import (
    BOARD,
    FLANGE_FROM_CAMERA,
    NOMINAL,
    PRIORS,
    RAIL,
    observe,
)


@pytest.fixture(scope="module")
def observations() -> list[TargetObservation]:
    """Through one camera, the rail standing still."""
    seen = [o for o in observe(np.random.default_rng(5), 30) if o.view is not None]
    return [TargetObservation(o.view, o.base_from_flange * still(o.rail_position), o.name) for o in seen]


def still(position: float) -> pin.SE3:
    """What the flange would have moved to take the camera where the rail took it."""
    return FLANGE_FROM_CAMERA * from_parts(position * RAIL) * FLANGE_FROM_CAMERA.inverse()


def adjusted(observations: list[TargetObservation], larger: float) -> Joint:
    """Of a board that is larger by that share than its name says."""
    named = replace(BOARD, pitch=BOARD.pitch / (1.0 + larger))
    made = []
    for o in observations:
        made.append(replace(o, view=replace(o.view, spec=named, dot_radius=named.dot_radius)))
    return adjust_target(made, NOMINAL, PRIORS)


@pytest.mark.parametrize("larger", [0.0, 5.5e-3, -6.5e-3])
def test_its_size_is_found_and_what_is_noted_is_stated(observations: list[TargetObservation], larger: float) -> None:
    joint = adjusted(observations, larger)
    assert joint.size is not None
    assert joint.size.share == pytest.approx(larger, abs=1.5e-3)
    notes = joint.size.notes
    if not larger:
        assert not joint.size.noted and notes == ()
        return
    assert f"the large board is {1 + joint.size.share:.4f}" in notes[0] and "Measure the pitch" in notes[0]
    # What it moves of the calibration is within what is stated.
    moved = joint.size.moved
    sigma = np.sqrt(np.diag(joint.adjusted.reliable_covariance))
    assert (np.abs(moved) <= sigma * (1 + 1e-9)).all() and np.abs(moved).max() > 0.0


@pytest.mark.parametrize("larger", [0.01, -0.01])
def test_one_of_another_size_is_refused_with_the_pitch_that_fits(
    observations: list[TargetObservation], larger: float
) -> None:
    # Named so, the true pitch of 3 mm is the one that the refusal tells.
    with pytest.raises(
        RefusedError, match=r"large board is \d\.\d+ ± .*pitch would be (2\.99|3\.00|3\.01|3)\d* mm"
    ) as told:
        adjusted(observations, larger)
    assert "[calibration.large]" in str(told.value)
    assert abs(told.value.numbers[0].value) == pytest.approx(1.0, abs=0.2)
