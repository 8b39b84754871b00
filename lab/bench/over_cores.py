"""Work that is spread over the cores, a process each, and handed on as it ends. It must not depend on its process."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from typing import Any

from statemachine.watch import SignalInterrupt

Task = tuple[Any, ...]
"""A function and what it is called with."""
Done = Callable[[str], None]
"""Told in words of each thing that is done."""
SINGLE_THREADED = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def over_cores(tasks: Sequence[Task], workers: int = 0, ended: Callable[[Any], None] = lambda made: None) -> list[Any]:
    """What each task makes, in their order; `ended` gets each as soon as it is there. `workers` processes, by default
    one a core. What a task raises is raised here; those that wait are then dropped."""
    # One thread a process: the sums, and so the figures, are then the same on every machine and the cores are full.
    for name in SINGLE_THREADED:
        os.environ.setdefault(name, "1")
    pool = ProcessPoolExecutor(
        workers or len(os.sched_getaffinity(0)), get_context("spawn"), initializer=_vision_on_one_thread
    )
    try:
        waiting = [pool.submit(*task) for task in tasks]
        for future in as_completed(waiting):
            ended(future.result())
        return [future.result() for future in waiting]
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
