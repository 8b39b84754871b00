"""How the hot loops of the cell are compiled, and whether they can be.

Where numba is missing, broken or switched off, `AVAILABLE` is False and `compiled` leaves functions as they are. That
is enough to look at a picture, not to run a job, and is said once.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

try:
    import numba

    AVAILABLE = not getattr(numba.config, "DISABLE_JIT", 0)
    _reason = "it is switched off"
except Exception as error:  # A numba that does not fit the installed numpy or LLVM raises more than ImportError.
    AVAILABLE = False
    _reason = f"{type(error).__name__}: {error}"
if not AVAILABLE:
    warnings.warn(
        f"numba cannot compile here ({_reason}): a picture's stripe takes seconds, calibrations and clouds are made "
        "some hundred times slower, so that a job's steps run past their deadlines. Reinstall numba",
        RuntimeWarning,
        stacklevel=2,
    )

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """Compile on first use, without the interpreter's lock, kept on disk where that can be written."""
    return _compile(function, fastmath=False)


def compiled_fast(function: Kernel) -> Kernel:
    """As `compiled`, with sums in any order: for loops over pixels that hold no NaN."""
    return _compile(function, fastmath=True)


def is_kept(function: Callable[..., object]) -> bool:
    """Whether what `compiled` gave lies compiled on disk, in some version; True where nothing can be compiled."""
    if not AVAILABLE:
        return True
    folder = function.stats.cache_path  # type: ignore[attr-defined]
    return folder is None or any(Path(folder).glob(f"*.{function.__name__}-*.nbi"))


def _compile(function: Kernel, fastmath: bool) -> Kernel:
    if not AVAILABLE:
        return function
    options: dict[str, Any] = {"nogil": True, "fastmath": fastmath, "error_model": "numpy"}
    try:
        made: Kernel = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # No writable place for the cache.
        made = numba.njit(**options)(function)
    return made
