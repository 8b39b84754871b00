"""Intervals and Cpk against scipy, tables of others, and numbers reckoned by hand."""

import pytest
from scipy import stats

from cell.apps.qualify.intervals import Share, cpk, mean_difference, share_difference


@pytest.mark.parametrize(("count", "of"), [(0, 20), (1, 20), (15, 20), (20, 20), (1992, 2000)])
def test_the_interval_of_a_share_is_that_of_clopper_and_pearson(count: int, of: int):
    wanted = stats.binomtest(count, of).proportion_ci(0.95, method="exact")
    share = Share(count, of)
    assert (share.low, share.high) == pytest.approx((wanted.low, wanted.high), abs=1e-9)


def test_all_of_n_worlds_leave_what_the_closed_form_says():
    assert Share(40, 40).half_width == pytest.approx(0.5 * (1 - 0.025 ** (1 / 40)))
    assert str(Share(199, 200)) == "99.5 % [97.2, 100.0]"


def test_a_mean_difference_has_the_interval_of_students_t():
    values = [0.1, 0.3, -0.2, 0.4, 0.05]
    wanted = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert mean_difference(values) == pytest.approx((0.13, wanted.low, wanted.high))
    assert mean_difference([0.1]) == (0.1, None, None)


def test_a_difference_of_paired_shares_is_that_of_agresti_and_min():
    # By hand: b = 12.5, c = 5.5, n = 102: 7 / 102 ± 1.95996 √(18 - 49 / 102) / 102.
    assert share_difference(12, 5, 100) == pytest.approx((0.07, -0.011800, 0.149055), abs=2e-4)
    same, low, high = share_difference(0, 0, 50)
    assert same == 0.0
    assert low == pytest.approx(-high)
    assert high > 0.0


def test_cpk_by_hand():
    # Mean 0.2, σ 0.1 and limit 0.5: one such distance of 0.3 holds one three σ.
    assert cpk([0.1, 0.2, 0.3], [0.5] * 3) == pytest.approx(1.0)
    assert cpk([-0.1, -0.2, -0.3], [0.5] * 3) == pytest.approx(1.0), "an upper limit holds for either sign"
    assert cpk([80.0, 90.0, 100.0], [60.0] * 3, at_least=True) == pytest.approx(1.0)
    assert cpk([0.1, 0.4, 0.9], [0.5, 1.0, 1.5]) == pytest.approx((1 - 0.4) / (3 * 0.2)), "each in shares of its limit"
    assert cpk([0.1], [0.5]) is None and cpk([0.1, 0.1], [0.5, 0.5]) is None
