"""Two campaigns, seed by seed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cell.apps.qualify.campaign import Target
from cell.apps.qualify.compare import compare, other_rows
from cell.apps.qualify.rows import RowStore
from drivers.errors import ConfigError
from tests.support.qualified import OF, campaign, row

pytest.importorskip("pyarrow")
OLD = replace(OF, code_hash="old")


def test_pairs_are_of_the_same_seed() -> None:
    now = [row(1, error_mm=0.1), row(2, error_mm=0.2), row(3, "refused", reason="dark"), row(9)]
    before = [row(3, of=OLD), row(2, error_mm=0.3, of=OLD), row(1, error_mm=0.2, of=OLD), row(8, of=OLD)]
    told = compare(now, before)
    assert (told.pairs, told.other["code_hash"]) == (3, "old")
    assert told.yields[0] == pytest.approx(-1 / 3)
    assert [(one.seed, one.before, one.now, one.reason) for one in told.changed] == [(3, "placed", "refused", "dark")]
    figure = next(one for one in told.figures if one.name == "place error, largest of 45 points")
    assert (figure.mean, figure.n) == (pytest.approx(-0.1), 2)
    with pytest.raises(ConfigError, match="no seed in common"):
        compare([row(1)], [row(2)])


def test_in_one_folder_it_is_the_other_version_that_ran_last(tmp_path: Path) -> None:
    store, older = RowStore(tmp_path), replace(OF, code_hash="older")
    for one in (row(1), row(1, of=OLD, ended_s=2e9), row(2, of=OLD, ended_s=3e9), row(1, of=older, ended_s=1e9)):
        store.append(one)
    found = other_rows(campaign(tmp_path, Target(2)), tmp_path)
    assert {one["code_hash"] for one in found} == {"old"}
    assert len(found) == 2


def test_where_there_is_nothing_to_compare_with_that_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds no campaign"):
        other_rows(campaign(tmp_path, Target(2)), tmp_path)
    RowStore(tmp_path).append(row(1))
    with pytest.raises(ConfigError, match="no other worlds"):
        other_rows(campaign(tmp_path, Target(2)), tmp_path)
    assert len(other_rows(campaign(tmp_path / "other", Target(2)), tmp_path)) == 1
