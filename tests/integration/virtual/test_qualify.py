"""`cell qualify` as a user runs it: worlds in processes of their own, killed, resumed, and compared bit for bit."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cell.apps.qualify.rows import RowStore
from tests.support import ROOT, running, until
from tests.support.qualified import compared

pytest.importorskip("pyarrow")
pytestmark = pytest.mark.campaign


def begin(folder: Path, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", "from cell.apps.cli import main; main()", "qualify", "pot", *words], cwd=folder,
        text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip


def qualified(folder: Path, *words: str) -> dict[str, object]:
    out, error = begin(folder, *words, "--json").communicate(timeout=600)
    assert out, error
    told: dict[str, object] = json.loads(out)
    return told


def rows(folder: Path) -> list[dict[str, object]]:
    found = [compared(row) for row in RowStore(folder).rows()]
    return sorted(found, key=lambda row: str(row["seed"]))


def test_one_and_two_workers_and_a_cluster_give_the_same_rows(tmp_path):
    pytest.importorskip("distributed")
    one = qualified(tmp_path, "--seeds", "2", "--workers", "1", "--out", "one")
    two = qualified(tmp_path, "--seeds", "2", "--workers", "2", "--out", "two")
    qualified(tmp_path, "--seeds", "2", "--cluster", "local:2", "--out", "three")
    assert rows(tmp_path / "one") == rows(tmp_path / "two") == rows(tmp_path / "three")
    assert len(rows(tmp_path / "one")) == 2
    assert one["shares"] == two["shares"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_what_is_killed_goes_on_and_leaves_no_process(tmp_path, number: int):
    store = RowStore(tmp_path / "out")
    going = begin(tmp_path, "--seeds", "3", "--workers", "2", "--out", "out")
    assert until(lambda: store.rows(), 300.0)
    children = Path(f"/proc/{going.pid}/task/{going.pid}/children").read_text().split()
    going.send_signal(number)
    _, complaints = going.communicate(timeout=60)
    assert going.returncode == (130 if number == signal.SIGINT else -signal.SIGKILL)
    assert ("the same command goes on" in complaints) == (number == signal.SIGINT)
    assert until(lambda: not any(running(int(child)) for child in children))
    before = len(store.rows())
    assert 1 <= before < 3
    assert qualified(tmp_path, "--seeds", "3", "--workers", "2", "--out", "out")["worlds"] == 3
    assert len(list(store.folder.glob("*.parquet"))) == 1
