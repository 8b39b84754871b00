"""Promises of `cell.measure.reconstruction.outliers`."""

from typing import Any

import numpy as np
import pytest

from cell.measure.reconstruction import outliers
from cell.measure.reconstruction.outliers import find_outliers
from lab.bench.reconstruction.scenes import KINDS, scene


@pytest.mark.parametrize("half", [0, 1])
def test_a_half_that_could_not_be_judged_is_an_error_and_never_left_unfiltered(monkeypatch, half: int):
    whole = outliers._judge
    middle = 20

    def judge(*arguments: Any, first: int, **others: Any) -> None:
        if (first >= middle) == bool(half):
            raise MemoryError("no room")
        whole(*arguments, first=first, **others)

    monkeypatch.setattr(outliers, "_judge", judge)
    depth = np.zeros((2 * middle, 30))
    with pytest.raises(MemoryError, match="no room"):
        find_outliers(depth, np.full_like(depth, 1e-5))


def test_a_lone_point_is_an_outlier_and_an_empty_cloud_has_none():
    depth = np.full((20, 20), np.nan)
    assert not find_outliers(depth, np.ones_like(depth)).any()
    depth[10, 10] = 0.1
    assert find_outliers(depth, np.full_like(depth, 1e-5))[10, 10]


@pytest.mark.parametrize("surface", ["free-form", "steps"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.01, 0.05])
def test_outliers_are_found_and_little_else(surface: str, kind: str, share: float):
    made = scene(surface, kind, share, 8)
    found = find_outliers(made.depth, made.sigma)
    assert np.count_nonzero(found & made.bad) >= 0.99 * np.count_nonzero(made.bad)
    assert np.count_nonzero(found & made.bad) >= 0.90 * np.count_nonzero(found)
