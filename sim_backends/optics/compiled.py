"""How the kernels of the optics are compiled: once, kept on disk, and without holding the interpreter's lock.

Numba keeps compiled kernels by the file that they stand in and does not see when a kernel that they call has changed in
another file. They are therefore kept in a folder named after the text of all of them.
"""

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar, cast

import numba
from numba.core import config

Function = TypeVar("Function", bound=Callable[..., object])


def _cache_folder() -> str:
    here = Path(__file__).parent
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(here.rglob("*.py")))).hexdigest()[:16]
    root = here / "__pycache__" if os.access(here, os.W_OK) else Path.home() / ".cache" / "assembly-cell"
    return str(root / f"kernels-{digest}")


_FOLDER = _cache_folder()


@contextmanager
def _kept_there() -> Iterator[None]:
    """What is handed over in this block is kept in the folder, unless the user names another; nothing else is: the
    cell's own kernels are then compiled once, whether a process has a simulator in it or not."""
    named = getattr(config, "CACHE_DIR", "")
    vars(config)["CACHE_DIR"] = named or _FOLDER
    try:
        yield
    finally:
        vars(config)["CACHE_DIR"] = named


def compiled(function: Function) -> Function:
    """Compile with strict floating point; division by zero gives infinity as in numpy."""
    with _kept_there():
        return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def compiled_fast(function: Function) -> Function:
    """Compile with reordering of sums allowed, for loops over pixels that hold neither infinities nor NaN."""
    with _kept_there():
        return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)(function))
