"""A board that was printed larger or smaller than its name says is told by the arm's ways."""

from dataclasses import replace

import numpy as np
import pytest

from cell.measure.calibration.archive import Observations
from cell.measure.calibration.solve.joint import Joint
from cell.measure.calibration.solve.results import adjust_target
from drivers.errors import RefusedError


def adjusted(archived: Observations, larger: float) -> Joint:
    """Of a board that is larger by that share than its name says, seen through one camera, without the rail."""
    made = []
    for o in archived.target:
        named = replace(o.view.spec, pitch=o.view.spec.pitch / (1.0 + larger))
        made.append(replace(o, view=replace(o.view, spec=named, dot_radius=named.dot_radius)))
    return adjust_target(made, archived.target_camera, archived.priors)


@pytest.mark.parametrize("larger", [0.0, 5.5e-3])
def test_its_size_is_found_and_what_is_noted_is_stated(archived: Observations, larger: float):
    joint = adjusted(archived, larger)
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
def test_one_of_another_size_is_refused_with_the_pitch_that_fits(archived: Observations, larger: float):
    # Named so, the true pitch of 3 mm is the one that the refusal tells.
    told = r"large board is \d\.\d+ ± .*pitch would be (2\.99|3\.00|3\.01|3)\d* mm"
    with pytest.raises(RefusedError, match=told) as refused:
        adjusted(archived, larger)
    assert "[calibration.large]" in str(refused.value)
    assert abs(refused.value.numbers[0].value) == pytest.approx(1.0, abs=0.2)
