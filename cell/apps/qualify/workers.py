"""Who runs the worlds: processes of this machine, a Dask cluster of this machine, or a running Dask scheduler.

All are executors of `concurrent.futures`. A world whose worker died comes back without a row.
"""

from __future__ import annotations

import multiprocessing
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Protocol

from cell.apps.qualify.rows import Row
from cell.apps.qualify.world import WorldTask, limit_threads, run_world
from drivers.errors import CellError, ConfigError

if TYPE_CHECKING:
    from distributed import Client

Ended = tuple[WorldTask, Row | None]
"""A world and its row; None where its worker died, in this world or one that waited there, or was ended by a signal."""
World = Callable[[WorldTask], Row | None]
MOST_WORKERS = 1024
RENEWED = 100
"""Worlds after which a process is replaced by a new one: each world leaves some 3 MB that nothing gives back."""
WAITING = 4
"""Worlds that are handed to a cluster for each of its workers: one runs, the others are on their way."""
LOOK_S, ANSWER_S = 0.5, "20s"
"""How often it is looked whether the scheduler is still there, and how long it has to answer at first."""


class Workers(Protocol):
    """Runs worlds."""

    @property
    def room(self) -> int:
        """How many worlds may be begun at a time."""

    def begin(self, task: WorldTask) -> None:
        """Hand a world over."""

    def ended(self) -> Iterator[Ended]:
        """Wait until one has ended at least, and give those that have. Raises what is wrong with a worker's files."""

    def close(self) -> None:
        """End all workers, whatever they do."""


def require_workers(count: int) -> None:
    """`ConfigError` for so many workers."""
    if not 1 <= count <= MOST_WORKERS:
        raise ConfigError(f"{count} workers are none (allowed: 1 to {MOST_WORKERS}); give another number")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


@dataclass(eq=False)
class Processes:
    """Processes of this machine, each an executor of its own: one that dies takes no other's world with it."""

    room: int
    work: World = run_world
    _running: dict[Future[Row | None], tuple[WorldTask, ProcessPoolExecutor]] = field(default_factory=dict)
    _free: list[ProcessPoolExecutor] = field(default_factory=list)
    _ran: Counter[ProcessPoolExecutor] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        require_workers(self.room)
        limit_threads()

    def begin(self, task: WorldTask) -> None:
        while True:
            spawn = multiprocessing.get_context("spawn")
            pool = self._free.pop() if self._free else ProcessPoolExecutor(1, spawn, initializer=_begin_process)
            # One that died while it waited is left out.
            with suppress(BrokenProcessPool):
                self._running[pool.submit(self.work, task)] = task, pool
                return

    def ended(self) -> Iterator[Ended]:
        done, _ = wait(self._running, return_when=FIRST_COMPLETED)
        for future in done:
            task, pool = self._running.pop(future)
            try:
                row = future.result()
            except BrokenProcessPool:
                pool.shutdown(wait=True)
                yield task, None
                continue
            self._ran[pool] += 1
            if self._ran[pool] < RENEWED:
                self._free.append(pool)
            else:
                pool.shutdown(wait=True)
                del self._ran[pool]
            yield task, row

    def close(self) -> None:
        for pool in [*self._free, *(pool for _, pool in self._running.values())]:
            for process in list((pool._processes or {}).values()):
                process.kill()
            pool.shutdown(wait=True, cancel_futures=True)
        self._running.clear()
        self._free.clear()


def _begin_process() -> None:
    """Ctrl-C at the terminal is for the campaign alone, which then ends this process; so does the campaign's death."""
    import threading

    os.setpgid(0, 0)
    parent = multiprocessing.parent_process()

    def end_with_it() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_it, daemon=True).start()


@dataclass(eq=False)
class Cluster:
    """Workers of a Dask scheduler, through its executor."""

    client: Client
    own: bool
    work: World = run_world
    _running: dict[Future[Row | None], WorldTask] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._executor: Executor = self.client.get_executor(pure=False)

    @property
    def room(self) -> int:
        """See `Workers`; it grows with workers that come later."""
        return WAITING * max(1, len(self.client.scheduler_info(n_workers=-1)["workers"]))

    def begin(self, task: WorldTask) -> None:
        self._require_scheduler()
        self._running[self._executor.submit(self.work, task)] = task

    def ended(self) -> Iterator[Ended]:
        """See `Workers`. Raises `CellError` where the scheduler has gone away."""
        from distributed import KilledWorker

        done: set[Future[Row | None]] = set()
        while not done:
            self._require_scheduler()
            done, _ = wait(self._running, timeout=LOOK_S, return_when=FIRST_COMPLETED)
        for future in done:
            try:
                row = future.result()
            except KilledWorker:
                row = None
            except CancelledError as error:
                raise self._lost() from error
            task = self._running.pop(future)
            yield task, row

    def close(self) -> None:
        """See `Workers`. A scheduler that was there before stays."""
        for future in self._running:
            future.cancel()
        with suppress(Exception):
            self.client.close(timeout=5)
        if self.own and self.client.cluster is not None:
            with suppress(Exception):
                self.client.cluster.close(timeout=10)

    def _require_scheduler(self) -> None:
        if self.client.status != "running":
            raise self._lost()

    def _lost(self) -> CellError:
        return CellError(
            "the scheduler has gone away; the rows that came are kept. Start it again, then run the same command again "
            "to go on"
        )


def open_workers(count: int | None, scheduler: str | None, cluster: str | None) -> Workers:
    """What `--workers`, `--scheduler` and `--cluster` name: by default a process for each core. Raises `ConfigError`
    for what is none of these, for a missing package, and where no scheduler answers."""
    if [count, scheduler, cluster].count(None) < 2:
        raise ConfigError("--workers, --scheduler and --cluster exclude each other; give one of them")
    if scheduler is not None:
        if not re.fullmatch(r"(tcp|tls)://[^/\s]+:\d{1,5}", scheduler):
            raise ConfigError(f"--scheduler {scheduler} is no address (allowed: tcp://HOST:PORT or tls://HOST:PORT)")
        return _connected(scheduler)
    if cluster is not None:
        if not re.fullmatch(r"local:\d{1,4}", cluster):
            raise ConfigError(f"--cluster {cluster} is not offered (allowed: local:N, N workers of this machine)")
        return _local(int(cluster.removeprefix("local:")))
    return Processes(cores() if count is None else count)


def _prepare() -> None:
    """`ConfigError` without Dask, which then leaves it to the campaign to try a world again whose worker died."""
    if find_spec("distributed") is None:
        raise ConfigError("a cluster needs Dask; in the checkout: pip install -e '.[cluster]'")
    import dask

    dask.config.set({"distributed.scheduler.allowed-failures": 0, "distributed.comm.timeouts.connect": ANSWER_S})
    limit_threads()


def _connected(scheduler: str) -> Cluster:
    _prepare()
    from distributed import Client

    try:
        return Cluster(Client(scheduler, timeout=ANSWER_S), own=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"no scheduler answers at {scheduler}: {error}; start it, or name another address") from error
    except (TypeError, RuntimeError) as error:
        # What Dask raises where its settings of TLS and the address do not go together.
        tls = "give Dask its certificates for tls://, or take its settings of TLS away (docs/how-to/qualify.md)"
        raise ConfigError(f"{scheduler} cannot be asked: {error}; {tls}") from error


def _local(count: int) -> Cluster:
    """A scheduler and workers on the loopback alone."""
    require_workers(count)
    _prepare()
    from distributed import Client, LocalCluster

    started = LocalCluster(
        n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None,
        silence_logs=50, memory_limit=None,
    )  # fmt: skip
    return Cluster(Client(started), own=True)
