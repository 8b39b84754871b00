"""How the hot loops of this package are compiled, and whether they can be.

Where numba is missing, broken or switched off, `AVAILABLE` is False, `compiled` leaves functions as they are, and
`stripe.py` takes the numpy way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

try:
    import numba

    AVAILABLE = not getattr(numba.config, "DISABLE_JIT", 0)
except Exception:  # A numba that does not fit the installed numpy or LLVM raises more than ImportError.
    AVAILABLE = False


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile on first use, without the interpreter's lock, kept on disk where that can be written."""
    return _compile(function, fastmath=False)


def compiled_fast(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `compiled`, with sums in any order: for loops over pixels that hold no NaN."""
    return _compile(function, fastmath=True)


def _compile(function: Callable[..., Any], fastmath: bool) -> Callable[..., Any]:
    if not AVAILABLE:
        return function
    options: dict[str, Any] = {"nogil": True, "fastmath": fastmath, "error_model": "numpy"}
    try:
        made = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # No writable place for the cache.
        made = numba.njit(**options)(function)
    return made  # type: ignore[no-any-return]
