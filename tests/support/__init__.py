"""What tests share: benches, scenes, runs that ended, peers of others. Nothing here is a test."""

import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[2]
"""The checkout."""
Typed = Callable[..., tuple[int, str, str]]
"""What the fixture `typed` gives: what a `cell` command comes to: exit code, output, complaints."""


def until(true: Callable[[], object], seconds: float = 10.0) -> bool:
    """Whether it becomes true within so many seconds of the wall."""
    end = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end:
            return False
        time.sleep(0.005)
    return True


def running(pid: int) -> bool:
    """Whether a process lives, and is no corpse that nobody has looked at."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False
