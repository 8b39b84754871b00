"""How the hot loops of the cell are compiled, and whether they can be.

numba takes longest of all to load: it is, and the loops are handed to it, when `load` says so or the first one is
called. Where it is missing, broken or switched off, functions stay as they are. That is enough to look at a picture,
not to run a job, and is said once.
"""

import threading
import warnings
from collections.abc import Callable
from functools import cache, update_wrapper
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """Compile on first use, without the interpreter's lock, kept on disk where that can be written."""
    return cast(Kernel, _Loop(function, fastmath=False))


def compiled_fast(function: Kernel) -> Kernel:
    """As `compiled`, with sums in any order: for loops over pixels that hold no NaN."""
    return cast(Kernel, _Loop(function, fastmath=True))


def load() -> None:
    """Load numba, and hand it all loops that were imported so far: before anything moves, which would wait for it.

    Where a loop stands in a module under its name, there stands then what numba made of it: loops call each other so.
    """
    with _one_at_a_time:
        waiting = [loop for loop in _loops if loop.kernel is None]
        made = {id(loop): _handed_over(loop) for loop in waiting}
        for loop in waiting:
            names, code = loop.function.__globals__, loop.function.__code__
            for name in (*code.co_names, loop.function.__name__):
                if isinstance(called := names.get(name), _Loop):
                    names[name] = made.get(id(called), called.kernel)
        for loop in waiting:
            loop.kernel = made[id(loop)]


def is_kept(function: Callable[..., object]) -> bool:
    """Whether what `compiled` gave lies compiled on disk, in some version; True where nothing can be compiled."""
    if _numba() is None:
        return True
    folder = function.stats.cache_path  # type: ignore[attr-defined]
    return folder is None or any(Path(folder).glob(f"*.{function.__name__}-*.nbi"))


@cache
def _numba() -> Any:
    try:
        import numba

        reason = "it is switched off" if getattr(numba.config, "DISABLE_JIT", 0) else ""
    except Exception as error:  # A numba that does not fit the installed numpy or LLVM raises more than ImportError.
        reason = f"{type(error).__name__}: {error}"
    if not reason:
        return numba
    warnings.warn(
        f"numba cannot compile here ({reason}): a picture's stripe takes seconds, calibrations and clouds are made "
        "some hundred times slower, so that a job's steps run past their deadlines. Reinstall numba",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


class _Loop:
    """A function that is handed to numba when it is first called or asked for anything else."""

    def __init__(self, function: Callable[..., object], fastmath: bool) -> None:
        update_wrapper(self, function)
        self.function, self.fastmath = cast(FunctionType, function), fastmath
        self.kernel: Any = None
        _loops.append(self)

    def __call__(self, *arguments: object, **named: object) -> object:
        if self.kernel is None:
            load()
        return self.kernel(*arguments, **named)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "kernel":
            raise AttributeError(name)
        if self.kernel is None:
            load()
        return getattr(self.kernel, name)


def _handed_over(loop: _Loop) -> Any:
    """What numba makes of it when it is called; the function itself without numba."""
    if (numba := _numba()) is None:
        return loop.function
    options = {"nogil": True, "fastmath": loop.fastmath, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(loop.function)
    except RuntimeError:  # No writable place for the cache.
        return numba.njit(**options)(loop.function)


_loops: list[_Loop] = []
_one_at_a_time = threading.RLock()
