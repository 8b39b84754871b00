"""Processes and clusters: the same rows, whoever dies; clear words for what cannot be."""

import threading
import time
from multiprocessing import active_children
from pathlib import Path

import distributed
import pytest

from cell.apps.qualify import workers as module
from cell.apps.qualify.campaign import Prefix, Target
from cell.apps.qualify.rows import Row, RowStore
from cell.apps.qualify.workers import Cluster, Processes, Workers, open_workers
from drivers.errors import CellError, ConfigError
from tests.support.qualified import campaign, deadly, other_code, quick

pytest.importorskip("pyarrow")


def rows(folder: Path, workers: Workers, count: int = 6) -> dict[int, Row]:
    wanted = campaign(folder, Target(count))
    wanted.run(RowStore(folder), lambda: workers, lambda prefix: None)
    return {int(str(row["seed"])): row for row in wanted.rows(RowStore(folder), count)}


def require_same(found: dict[int, Row], folder: Path) -> None:
    """As worlds give them whose workers live, but for the third, which kills each of its own."""
    assert found.pop(3)["code"] == "WorkerDied"
    assert found == {seed: quick(campaign(folder, Target(1)).task(seed)) for seed in found}


def test_a_process_that_dies_takes_no_other_world_with_it(tmp_path):
    require_same(rows(tmp_path, Processes(2, deadly), 4), tmp_path)


def test_a_process_that_died_or_has_run_enough_is_replaced(tmp_path, monkeypatch):
    workers, wanted = Processes(1, quick), campaign(tmp_path, Target(3))
    workers.begin(wanted.task(1))
    assert [row and row["seed"] for _, row in workers.ended()] == [1]
    for process in active_children():
        process.kill()
        process.join()
    found: list[Row] = []
    # At once after its death nobody knows of it yet: the world comes back without a row.
    while not found:
        workers.begin(wanted.task(2))
        found = [row for _, row in workers.ended() if row is not None]
    assert [row["seed"] for row in found] == [2]
    monkeypatch.setattr(module, "RENEWED", 1)
    workers.begin(wanted.task(3))
    assert [row and row["seed"] for _, row in workers.ended()] == [3]
    assert not active_children(), "after so many worlds a process is replaced"
    workers.close()
    assert not active_children()


def test_a_worker_with_other_files_ends_the_campaign(tmp_path):
    with pytest.raises(ConfigError, match="another code"):
        rows(tmp_path, Processes(1, other_code))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ((0, None, None), "allowed: 1 to 1024"),
        ((2, None, "local:2"), "exclude each other"),
        ((None, "127.0.0.1:8786", None), "tcp://HOST:PORT"),
        ((None, None, "slurm:2"), "local:N"),
        ((None, None, "local:0"), "allowed: 1 to 1024"),
    ],
)
def test_what_names_no_workers_is_refused(given: tuple[int | None, str | None, str | None], told: str):
    with pytest.raises(ConfigError, match=told):
        open_workers(*given)


def test_without_dask_a_cluster_says_what_to_install(monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install -e '.\[cluster\]'"):
        open_workers(None, None, "local:2")


def test_by_default_each_core_has_a_process():
    assert open_workers(None, None, None).room == module.cores()


def test_a_cluster_gives_the_same_rows_although_workers_are_killed(tmp_path):
    cluster = open_workers(None, None, "local:2")
    assert isinstance(cluster, Cluster)
    cluster.work = deadly
    require_same(rows(tmp_path, cluster, 12), tmp_path)
    assert (tmp_path / "killed").exists()


def test_a_scheduler_that_goes_away_leaves_the_rows_and_says_how_to_go_on(tmp_path):
    started = distributed.LocalCluster(n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None)
    cluster = open_workers(None, started.scheduler_address, None)
    assert isinstance(cluster, Cluster)
    cluster.work = slow
    ends = threading.Thread(target=started.close)

    def shown(prefix: Prefix) -> None:
        if prefix.known == 3:
            ends.start()

    with pytest.raises(CellError, match="run the same command again"):
        campaign(tmp_path, Target(500)).run(RowStore(tmp_path), lambda: cluster, shown)
    ends.join()
    assert 3 <= len(RowStore(tmp_path).rows()) < 500


def test_where_no_scheduler_answers_its_address_is_told(monkeypatch):
    monkeypatch.setattr(module, "ANSWER_S", "1s")
    with pytest.raises(ConfigError, match=r"no scheduler answers at tcp://127\.0\.0\.1:1"):
        open_workers(None, "tcp://127.0.0.1:1", None)


def test_without_certificates_tls_says_what_is_missing():
    with pytest.raises(ConfigError, match="give Dask its certificates"):
        open_workers(None, "tls://127.0.0.1:1", None)


def slow(task: module.WorldTask) -> Row:
    time.sleep(0.05)
    return quick(task)
