"""Work that is spread over the cores, a process each, and handed on as it ends. It must not depend on its process."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from typing import Any, TypeVar

from statemachine.watch import SignalInterrupt

Task = tuple[Any, ...]
"""A function and what it is called with."""
Progress = Callable[[int, int], None]
"""Called with the number of finished items and of all."""
Item = TypeVar("Item")
Result = TypeVar("Result")
SINGLE_THREADED = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def over_cores(tasks: Sequence[Task], workers: int = 0) -> Iterator[tuple[int, Any]]:
    """The number and the result of each task, in the order in which they end.

    `workers` processes, by default one a core. What a task raises is raised here; those that wait are then dropped.
    """
    # One thread a process: the sums, and so the figures, are then the same on every machine and the cores are full.
    for name in SINGLE_THREADED:
        os.environ.setdefault(name, "1")
    pool = ProcessPoolExecutor(
        workers or len(os.sched_getaffinity(0)), get_context("spawn"), initializer=_vision_on_one_thread
    )
    try:
        waiting = {pool.submit(task[0], *task[1:]): number for number, task in enumerate(tasks)}
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    except (BrokenProcessPool, KeyboardInterrupt, SignalInterrupt):
        # A worker that was killed may hold the queue on which the others wait, and those keep SIGTERM for their runs.
        for worker in active_children():
            worker.kill()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _vision_on_one_thread() -> None:
    import cv2

    cv2.setNumThreads(1)


def run_all(
    one: Callable[[Item], Result], items: Iterable[Item], workers: int = 0, progress: Progress | None = None
) -> list[Result]:
    """The results of `one` for each item, such as a seed, in their order; with one worker in this process."""
    wanted = list(items)
    results: dict[int, Result] = {}
    ended: Iterable[tuple[int, Result]] = enumerate(map(one, wanted))
    if workers != 1:
        ended = over_cores([(one, item) for item in wanted], workers)
    for index, result in ended:
        results[index] = result
        if progress is not None:
            progress(len(results), len(wanted))
    return [results[index] for index in range(len(wanted))]
