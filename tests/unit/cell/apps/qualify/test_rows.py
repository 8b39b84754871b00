"""Rows from reports: worst item, figure nearest its limit, columns with their units."""

from pathlib import Path
from typing import Any

import pytest

from cell.apps.qualify import rows as stores
from cell.apps.qualify.rows import RowStore, column, row_of, shown, used
from drivers.errors import CellError, ConfigError
from tests.support.qualified import COVERED, ERROR, OF, row


def report(outcome: str = "placed", error: float = 0.2, **more: Any) -> dict[str, Any]:
    figure = {"name": "place error, largest of 45 points", "value": error, "unit": "mm", "limit": 0.6}
    return {
        "outcome": outcome, "reason": f"it {outcome}", "code": "", "cell_s": 50.0, "faults": [],
        "steps": [
            {"name": "place", "state": "done", "duration_s": 20.0, "retries": 1, "result": {}},
            {"name": "verify", "state": "done", "duration_s": 9.5, "retries": 0, "result": {"before_mm": [0.9]}},
        ],
        "measured": [{**figure, "bound": "at most", "kept": True}],
        "tolerance": {"translation_mm": 0.6}, "place_bound_95": {"d": 0.3},
        "truth": {"error_mm": {"d": {"mean": 0.5 * error, "max": error}}, "d_p95": 0.9 * error}, **more,
    }  # fmt: skip


def test_a_row_has_what_the_report_says():
    row = row_of(OF, "nominal", 7, [report()], covered=0.9)
    assert row["key"] == OF.key("nominal", 7)
    assert (row["outcome"], row["reason"], row["corrections"], row["retries"]) == ("placed", "", 1, 1)
    assert (row["cycle_s"], row["step_place_s"], row["points_covered"]) == (50.0, 20.0, 0.9)
    assert (row[ERROR], row[f"{ERROR} at most"], row["true_error_max_mm"]) == (0.2, 0.6, 0.2)
    assert (row["stated_bound_mm"], row["tolerance_mm"]) == (0.3, 0.6)


def test_a_job_of_several_items_is_as_good_as_its_worst():
    refused = report("refused", 0.5, truth=None)
    refused["steps"][0]["state"] = "failed"
    row = row_of(OF, "nominal", 7, [report(error=0.4), refused, report(error=0.1)])
    assert (row["outcome"], row["reason"], row["step"], row["parts"]) == ("refused", "it refused", "place", 3)
    assert (row["true_error_max_mm"], row[ERROR], row["cycle_s"]) == (0.4, 0.5, 150.0)


def test_a_figure_uses_a_share_of_its_limit():
    assert used(ERROR, -0.3, 0.6, " at most") == 0.5
    assert used(COVERED, 90.0, 60.0, " at least") == 0.25, "the best is 100 %"
    assert used("points [1]", 200.0, 100.0, " at least") == 0.5


@pytest.mark.parametrize(("name", "unit"), [("place error, stated 95 % bound", "mm"), ("fit, χ²/dof", "")])
def test_a_column_tells_its_figure_and_its_unit(name: str, unit: str):
    assert shown(column(name, unit)) == (name, unit)


pyarrow = pytest.importorskip("pyarrow.parquet")


def seeds(store: RowStore) -> list[int]:
    return sorted(int(str(one["seed"])) for one in store.rows())


def test_rows_come_back_as_they_were(tmp_path):
    store, rows = RowStore(tmp_path), [row(1), row(2, "refused", reason="too dark")]
    for one in rows:
        store.append(one)
    assert sorted(RowStore(tmp_path).rows(), key=lambda one: str(one["seed"])) == rows
    assert (store.outcomes(level="nominal"), store.rows(level="harsh")) == ({1: "placed", 2: "refused"}, [])


def test_a_kill_between_writing_and_renaming_loses_that_row_only(tmp_path, monkeypatch):
    store = RowStore(tmp_path)
    store.append(row(1))

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr(Path, "replace", killed)
        # A process that is killed removes nothing.
        broken.setattr(Path, "unlink", lambda *_, **__: None)
        with pytest.raises(KeyboardInterrupt):
            store.append(row(2))
    assert list(store.folder.glob("*.tmp"))
    again = RowStore(tmp_path)
    assert seeds(again) == [1]
    with again.writing():
        again.append(row(2))
    assert seeds(again) == [1, 2]
    assert not list(store.folder.glob("*.tmp"))


def test_a_kill_while_files_are_folded_doubles_no_row(tmp_path, monkeypatch):
    store = RowStore(tmp_path)
    for seed in range(5):
        store.append(row(seed))
    with monkeypatch.context() as broken:
        broken.setattr(Path, "unlink", lambda *_, **__: None)
        store.fold()
    assert len(list(store.folder.glob("*.parquet"))) == 6
    assert seeds(store) == list(range(5))
    store.fold()
    assert len(list(store.folder.glob("*.parquet"))) == 1
    assert seeds(RowStore(tmp_path)) == list(range(5))


def test_small_files_are_folded_now_and_then(tmp_path, monkeypatch):
    monkeypatch.setattr(stores, "SMALL", 4)
    store = RowStore(tmp_path)
    for seed in range(10):
        store.append(row(seed))
    assert len(list(store.folder.glob("fold-000004-*"))) == 2
    assert seeds(store) == list(range(10))


def test_columns_of_all_rows_are_there_for_others(tmp_path):
    store = RowStore(tmp_path)
    with store.writing():
        for one in (row(1, "refused"), row(2), row(3, note_mm=1.5)):
            store.append(one)
    table = pyarrow.read_table(store.folder)
    assert {"seed", "outcome", "note_mm", "true_error_max_mm"} <= set(table.column_names)
    assert table.num_rows == 3


def test_two_campaigns_do_not_write_into_one_folder(tmp_path):
    with (
        RowStore(tmp_path).writing(),
        pytest.raises(ConfigError, match="another campaign"),
        RowStore(tmp_path).writing(),
    ):
        pass


def test_what_is_wrong_with_the_folder_is_told(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="name another folder"):
        RowStore(tmp_path / "file")
    store = RowStore(tmp_path / "good")
    (store.folder / "x.parquet").write_bytes(b"nothing")
    with pytest.raises(CellError, match="remove it"):
        store.rows()
    monkeypatch.setattr(stores, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install -e '.\[qualify\]'"):
        RowStore(tmp_path / "good")
