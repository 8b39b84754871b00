"""A surface whose parts do not agree about its place is refused; noise, clutter and calibration are no disagreement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cell.measure.geometry.poses import difference
from cell.measure.inversion import Prior, invert_pose
from cell.measure.inversion.correspondences import Scan
from cell.measure.inversion.demands import _squares
from cell.measure.inversion.disagreement import Dissent, _beyond_noise, dissent
from cell.measure.inversion.registration import register
from cell.measure.reconstruction import Cloud
from lab.bench.inversion.campaign import task
from lab.bench.inversion.parts import PARTS, nominal
from lab.bench.inversion.refusals import BOARD, TOLERANCE, judge_case
from lab.bench.inversion.scenes import TRUE, Setting, scan

Array = NDArray[np.float64]
POT = PARTS["pot"].height
EDGE = -0.0175
"""A quarter of the pot lies at smaller x, m."""


def asked(deformed: Callable[[Array], Array]) -> Dissent:
    """Dissent at the true pose of a pot whose height has changed by a function of x."""
    cloud = scan(PARTS["pot"], np.random.default_rng(3), height=lambda x, y: POT(x, y) + deformed(x))
    return dissent(Scan.of(cloud), TRUE, nominal("pot"), TOLERANCE)


def test_a_quarter_that_has_sunk_is_found_with_its_depth() -> None:
    found = asked(lambda x: -0.0004 * (x < EDGE))
    assert found.shift == pytest.approx(0.0004, abs=1e-4)
    assert found.middle[0] < -0.015
    assert found.excess > 0.5


def test_a_quarter_that_is_tilted_is_found_with_its_angle() -> None:
    found = asked(lambda x: 0.006 * np.minimum(x - EDGE, 0.0))
    assert found.turn == pytest.approx(0.006, rel=0.1)
    assert found.shift == pytest.approx(0.006 * -EDGE, rel=0.15)
    assert found.middle[0] < EDGE


@pytest.mark.parametrize("axis", range(6))
def test_a_motion_along_any_axis_counts_beyond_three_sigma(axis: int) -> None:
    allowed = TOLERANCE.translation if axis < 3 else TOLERANCE.rotation
    motion, spread = np.zeros(6), np.zeros((6, 1))
    motion[axis], spread[axis] = 2.0 * allowed, 0.25 * allowed
    assert _beyond_noise(motion, spread, TOLERANCE) == pytest.approx(2.0 - 3 * 0.25)


def test_how_much_of_the_area_lies_off_is_told_by_squares() -> None:
    cloud = scan(PARTS["pot"], np.random.default_rng(3), height=lambda x, y: POT(x, y) + 0.001 * (x < EDGE))
    seen = Scan.of(cloud)
    medians = _squares(seen, TRUE, nominal("pot"))
    raised = ((seen.points - TRUE.translation) @ TRUE.rotation)[:, 0] < EDGE
    assert len(medians) > 50
    assert np.mean(np.abs(medians) > 0.5e-3) == pytest.approx(raised.mean(), abs=0.1)
    away = TRUE.copy()
    away.translation = away.translation + 1.0
    assert len(_squares(seen, away, nominal("pot"))) == 0


def test_noise_alone_is_no_dissent() -> None:
    assert asked(lambda x: 0.0 * x).excess < 0.05


@pytest.mark.parametrize("part", list(PARTS))
def test_foreign_objects_and_missing_data_are_no_dissent(part: str) -> None:
    rng = np.random.default_rng(8)
    for setting in (Setting(clutter=0.2), Setting(clutter=0.2, missing=0.4)):
        seen = Scan.of(scan(PARTS[part], rng, setting))
        pose = register(seen, nominal(part), Prior(TRUE, BOARD)).base_from_surface
        assert dissent(seen, pose, nominal(part), TOLERANCE).excess < 0.25


def test_what_the_calibration_explains_is_no_dissent() -> None:
    plain = scan(PARTS["pot"], np.random.default_rng(3))
    along = plain.points[:, :, 0] - TRUE.translation[0]
    bow = 0.0002 * (along[..., None] / 0.035) ** 2 * TRUE.rotation[:, 2]
    bent: Cloud = replace(plain, points=plain.points + bow)
    seen, moved = Scan.of(bent), bow[bent.subsample(10_000)][:, :, None]
    pose = register(seen, nominal("pot"), Prior(TRUE, BOARD)).base_from_surface
    assert dissent(seen, pose, nominal("pot"), TOLERANCE).excess > 0.5
    assert dissent(seen, pose, nominal("pot"), TOLERANCE, moved).excess < 0.05


@pytest.mark.parametrize("worn", [0.1e-3, 0.2e-3])
def test_a_wear_too_small_to_be_refused_is_stated_as_a_tilt_that_is_less_well_known(worn: float) -> None:
    cloud = scan(
        PARTS["pot"], np.random.default_rng(3), height=lambda x, y: POT(x, y) + worn * np.maximum(x, 0) / 0.035
    )
    found = invert_pose(cloud, nominal("pot"), Prior(TRUE, BOARD), TOLERANCE)
    tilt = np.abs(difference(found.base_from_surface, TRUE)[4])
    assert 0.1 < found.parts_differ < 0.5
    assert tilt > 5.0 * np.sqrt(found.random[4, 4]) and tilt > 0.5 * worn / 0.07
    assert tilt < 2.5 * found.sigma[4]


def test_a_surface_worn_like_a_ramp_is_not_taken_for_a_tilted_one() -> None:
    for seed in (0, 2, 4, 12):
        judged = judge_case("worn 0.3 to 2 mm on one side", seed)
        assert judged.ended == "refused"
        assert "the parts of the surface do not agree" in judged.reason


@pytest.mark.parametrize(("part", "seed"), [("seat", 1), ("seat", 30), ("pot", 6)])
def test_starts_that_mislead_a_search_with_few_points_lead_to_the_true_pose(part: str, seed: int) -> None:
    for outcome in task(part, seed):
        assert outcome.error[0] < 5e-5, outcome
        assert outcome.error[1] < 2e-3, outcome
