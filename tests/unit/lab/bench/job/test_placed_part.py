"""What `cell bench placed` sums up, and what it refuses; its effects are at work in the tests of `verify`."""

import pytest

from cell.procedures.placed_part import LIKELY
from drivers.errors import ConfigError
from lab.bench.job.part_effects import EFFECTS
from lab.bench.job.placed_part import _effect, _named, _placed, _seen, campaign

SLIPS, NOTHING = "slips as the claw opens, .5 mm in x", "nothing"
PLACED = {
    "effect": NOTHING, "outcome": "placed", "outside": False, "named": False, "true_mean": 0.03, "true_p95": 0.04,
    "bound": 0.05, "before": [0.08], "seen_off_by": 0.01, "seen_tilted_by": 0.1, "covered": True,
}  # fmt: skip
MISPLACED = {"effect": SLIPS, "outcome": "misplaced", "outside": False, "named": True}


def test_each_effect_names_a_cause_that_verify_tells():
    assert {cause for effect in EFFECTS.values() for cause in effect.causes} == set(LIKELY)
    assert len(EFFECTS) >= 32


def test_figures_are_of_the_parts_that_came_to_them():
    rows = [PLACED, {**PLACED, "true_mean": 0.05, "true_p95": 0.06, "outside": True, "seen_off_by": 0.03}, MISPLACED]
    assert _placed(rows) == {"parts": 2, "mean": pytest.approx(0.04), "p95": pytest.approx(0.049), "placings": 2.0}
    assert _seen(rows)["mean_mm"] == pytest.approx(0.02) and _seen(rows)["covered_95"] == 1.0
    told = _effect(rows)
    assert (told["placed"], told["misplaced"], told["outside"], told["true_p95_mm"]) == (2, 1, 1, 0.06)
    assert (_seen([MISPLACED]), _placed([MISPLACED])) == ({"parts": 0}, {"parts": 0})


def test_a_cause_is_named_or_the_part_was_never_put_down():
    refused = {**MISPLACED, "outcome": "refused", "named": False}
    unnamed = {**MISPLACED, "named": False}
    assert _named([PLACED]) is None
    assert _named([PLACED, MISPLACED, refused, unnamed]) == pytest.approx(2 / 3)


def test_an_effect_that_is_none_is_told_with_those_that_are():
    with pytest.raises(ConfigError, match="'a gust': allowed are nothing, held tilted"):
        campaign([1], "nominal", "pot", ["a gust"], "", lambda text: None)
