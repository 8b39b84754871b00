"""Work that is spread over the cores, a process each, and handed on as it ends."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any

Task = tuple[Any, ...]
"""A function and what it is called with."""
SINGLE_THREADED = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def over_cores(tasks: Sequence[Task], workers: int = 0) -> Iterator[tuple[int, Any]]:
    """The number and the result of each task, in the order in which they end.

    `workers` processes, by default one a core. What a task raises is raised here; those that wait are then dropped.
    """
    # One thread a process: the sums, and so the figures, are then the same on every machine and the cores are full.
    for name in SINGLE_THREADED:
        os.environ.setdefault(name, "1")
    pool = ProcessPoolExecutor(workers or len(os.sched_getaffinity(0)), get_context("spawn"))
    try:
        waiting = {pool.submit(task[0], *task[1:]): number for number, task in enumerate(tasks)}
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
