"""Where a part touched first: by closed forms, drawn errors and a flat part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cell.measure.inversion.first_contact import CROSS_TALK, LEVEL, LIMIT, ContactPoint, ContactRegion, contact_point
from drivers.errors import RefusedError

FLANGE = np.array([0.01, -0.02, 0.17])
"""Above the part, m."""
LEVEL_M = 0.002
CERTAIN = 1e-18 * np.eye(2)
SIGMA = np.array([0.3] * 3 + [0.015] * 3)
READINGS = 50
HALF = np.array([0.03, 0.02])


def wrench(place: tuple[float, float], force: tuple[float, float, float]) -> np.ndarray:
    """Of one force at a place of the underside, counted at the flange."""
    return np.concatenate([force, np.cross(np.array([*place, LEVEL_M]) - FLANGE, force)])


def still(mean: np.ndarray, count: int = READINGS) -> np.ndarray:
    return np.tile(mean, (count, 1))


def flat_part(gap: float = 0.0) -> ContactRegion:
    """A rectangle whose half at x < 0 stands `gap` m clear; the ground is known to 10 µm, tilts to 0.2 mrad."""
    x, y = (axis.ravel() for axis in np.meshgrid(*(np.linspace(-half, half, 11) for half in HALF)))
    tilts = np.random.default_rng(1).normal(0.0, 0.2e-3, (50, 2))
    ways = tilts[:, :1] * x + tilts[:, 1:] * y + np.where(x < 0.0, gap, 0.0)
    return ContactRegion(np.column_stack([x, y]), np.zeros(len(x)), LEVEL_M, ways, np.full(len(x), 10e-6))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("force", [(0.0, 0.0, 8.0), (2.0, -3.0, 7.0)])
def test_one_force_at_a_known_place_gives_that_place_whatever_its_way(
    force: tuple[float, float, float], sign: float
) -> None:
    before = np.array([0.4, -0.2, 1.0, 0.05, 0.02, -0.03])
    after = before + sign * wrench((0.012, -0.007), force)
    found = contact_point(still(before), still(after), FLANGE, level=LEVEL_M, held=CERTAIN)
    assert found is not None
    assert found.place == pytest.approx((0.012, -0.007), abs=1e-12)


def test_its_covariance_is_that_of_drawn_errors() -> None:
    rng, force = np.random.default_rng(2), (1.0, -2.0, 8.0)
    held = np.diag([0.2e-3, 0.1e-3]) ** 2
    found = []
    for _ in range(2000):
        before = rng.normal(0.0, SIGMA, (READINGS, 6))
        talk = np.concatenate([rng.normal(0.0, CROSS_TALK * np.linalg.norm(force), 3), np.zeros(3)])
        after = rng.normal(0.0, SIGMA, (READINGS, 6)) + wrench((0.01, 0.005), force) + talk
        one = contact_point(before, after, FLANGE, level=LEVEL_M, held=held)
        assert one is not None
        found.append(replace(one, place=one.place + rng.normal(0.0, np.sqrt(np.diag(held)))))
    scatter = np.cov(np.array([one.place for one in found]).T)
    stated = np.mean([one.covariance for one in found], axis=0)
    # Readings that follow one another by chance are taken for fewer: some percent are stated too much.
    assert np.sqrt(np.diag(scatter)) == pytest.approx(np.sqrt(np.diag(stated)), rel=0.1)
    assert np.all(np.diag(stated) > 0.97 * np.diag(scatter))


def test_what_pulls_from_the_side_is_far_beside_the_part_and_too_few_readings_tell_nothing() -> None:
    """A cable that pulls along x, 12 cm above the underside."""
    pull = np.array([8.0, 0.0, 0.0, *np.cross(np.array([0.0, 0.0, 0.12]) - FLANGE, (8.0, 0.0, 0.0))])
    found = contact_point(still(0 * pull), still(pull), FLANGE, level=LEVEL_M, held=CERTAIN)
    assert found is not None and abs(found.place[0]) > 0.5
    assert contact_point(still(0 * pull), still(pull, 9), FLANGE, level=LEVEL_M, held=CERTAIN) is None


def test_a_flat_part_may_touch_anywhere_and_one_half_of_it_where_the_other_is_clear() -> None:
    low = np.array([[-1.0, 0.0], [0.0, -1.0]])
    for region, pressed, reach in (
        (flat_part(), 0.1e-3, HALF),
        (half := flat_part(gap=1e-3), 0.1e-3, (0.0, HALF[1])),
        (half, 1.1e-3, HALF),
        (replace(half, slack=np.where(half.crossings[:, 0] < -0.02, np.inf, half.slack)), 0.1e-3, HALF),
        (replace(half, spread=np.full(len(half.spread), 1e-3)), 0.1e-3, (1e-3, HALF[1] + 1e-3)),
    ):
        assert region.reach(low, pressed) == pytest.approx(reach, abs=1e-9)


def test_a_contact_at_the_very_edge_is_taken_for_an_impossible_one_no_oftener_than_stated() -> None:
    region, rng = flat_part(), np.random.default_rng(3)
    covariance = np.array([[4.0, 1.5], [1.5, 2.0]]) * 1e-6
    for edge in (HALF, np.array([HALF[0], 0.0])):
        drawn = rng.multivariate_normal(edge, covariance, 1000)
        chances = np.array([region.judge(ContactPoint(place, covariance), 0.1e-3).chance for place in drawn])
        for level in (0.3, 0.05, 0.01):
            assert np.mean(chances < level) <= level


def test_how_far_beside_the_part_something_pushes_is_told_and_refused_beyond_the_limit() -> None:
    region, covariance = flat_part(), 4e-6 * np.eye(2)
    inside = region.judge(ContactPoint(np.array([0.01, 0.01]), covariance), 0.1e-3)
    assert (inside.beside, inside.chance, inside.width) == (0.0, 1.0, pytest.approx(0.04))
    for share, refused in ((0.99, False), (1.01, True)):
        off = share * LIMIT * 2e-3
        found = region.judge(ContactPoint(np.array([0.01, HALF[1] + off]), covariance), 0.1e-3)
        assert found.beside == pytest.approx(off)
        assert found.chance == pytest.approx(np.exp(-0.5 * (off / 2e-3) ** 2))
        assert (found.chance < LEVEL) is refused
        if not refused:
            found.require()
            continue
        with pytest.raises(
            RefusedError, match=r"at x \+10, y \+29 mm of the part's frame .* 9 mm beside .* still held"
        ):
            found.require()
    assert found.as_dict()["judged"] is True and found.as_dict()["y_mm"] == pytest.approx(28.67, abs=0.01)


def test_a_place_that_is_hardly_known_is_not_judged_and_that_is_said() -> None:
    region = flat_part()
    for sigma, judged in ((0.0133, True), (0.0134, False)):
        far = region.judge(ContactPoint(np.array([0.5, 0.0]), sigma**2 * np.eye(2)), 0.1e-3)
        assert far.judged is judged and bool(far.notes) is not judged
    far.require()
    assert "known to 13 mm (1 sigma) only: it was not judged" in far.notes[0]
