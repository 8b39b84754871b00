"""The same simulation over many seeds, on all cores, with its progress. What is run must not depend on the process."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

Progress = Callable[[int, int], None]
"""Called with the number of finished items and of all."""
Item = TypeVar("Item")

THREAD_SETTINGS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def run_all(
    one: Callable[[Item], dict[str, Any]], items: Iterable[Item], workers: int, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """The results of `one` for each item, such as a seed, in their order, from `workers` processes (1: in this one)."""
    wanted = list(items)
    results: dict[int, dict[str, Any]] = {}
    report = progress or (lambda done, total: None)
    report(0, len(wanted))
    if workers <= 1 or len(wanted) == 1:
        for index, item in enumerate(wanted):
            results[index] = one(item)
            report(len(results), len(wanted))
    else:
        with _single_threaded(), ProcessPoolExecutor(min(workers, len(wanted)), get_context("spawn")) as pool:
            asked = {pool.submit(one, item): index for index, item in enumerate(wanted)}
            for done in as_completed(asked):
                results[asked[done]] = done.result()
                report(len(results), len(wanted))
    return [results[index] for index in range(len(wanted))]


def spread(values: ArrayLike) -> dict[str, float]:
    """Mean, median, 95th percentile and largest of values over seeds."""
    v = np.asarray(values, dtype=np.float64)
    return {
        "mean": float(v.mean()),
        "median": float(np.median(v)),
        "p95": float(np.percentile(v, 95)),
        "max": float(v.max()),
    }


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _single_threaded() -> Iterator[None]:
    """One thread for linear algebra in each started process: they would only wait for each other."""
    before = {name: os.environ.get(name) for name in THREAD_SETTINGS}
    os.environ.update(dict.fromkeys(THREAD_SETTINGS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
