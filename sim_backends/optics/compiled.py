"""How the kernels of the optics are compiled: once, kept on disk, and without holding the interpreter's lock."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compile with strict floating point; division by zero gives infinity as in numpy."""
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def compiled_fast(function: Function) -> Function:
    """Compile with reordering of sums allowed, for loops over pixels that hold neither infinities nor NaN."""
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)(function))
