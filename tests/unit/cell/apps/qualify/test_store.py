"""Rows on the disk: nothing is lost or doubled, whenever the process is killed."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.apps.qualify import store as stores
from cell.apps.qualify.store import RowStore
from drivers.errors import CellError, ConfigError
from tests.support.qualified import row

pyarrow = pytest.importorskip("pyarrow.parquet")


def seeds(store: RowStore) -> list[int]:
    return sorted(int(str(one["seed"])) for one in store.rows())


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    store, rows = RowStore(tmp_path), [row(1), row(2, "refused", reason="too dark")]
    for one in rows:
        store.append(one)
    assert sorted(RowStore(tmp_path).rows(), key=lambda one: str(one["seed"])) == rows
    assert store.outcomes(level="nominal") == {1: "placed", 2: "refused"}
    assert store.rows(level="harsh") == []


def test_a_kill_between_writing_and_renaming_loses_that_row_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_a_kill_while_files_are_folded_doubles_no_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_small_files_are_folded_now_and_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "SMALL", 4)
    store = RowStore(tmp_path)
    for seed in range(10):
        store.append(row(seed))
    assert len(list(store.folder.glob("fold-000004-*"))) == 2
    assert seeds(store) == list(range(10))


def test_columns_of_all_rows_are_there_for_others(tmp_path: Path) -> None:
    store = RowStore(tmp_path)
    with store.writing():
        for one in (row(1, "refused"), row(2), row(3, note_mm=1.5)):
            store.append(one)
    table = pyarrow.read_table(store.folder)
    assert {"seed", "outcome", "note_mm", "true_error_max_mm"} <= set(table.column_names)
    assert table.num_rows == 3


def test_two_campaigns_do_not_write_into_one_folder(tmp_path: Path) -> None:
    with (
        RowStore(tmp_path).writing(),
        pytest.raises(ConfigError, match="another campaign"),
        RowStore(tmp_path).writing(),
    ):
        pass


def test_what_is_wrong_with_the_folder_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
