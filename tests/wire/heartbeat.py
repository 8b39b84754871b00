"""Whether this machine kept the wall's time: a process that wakes every 5 ms and tells when it woke late.

The simulated devices and their drivers keep deadlines on the wall. A virtual machine that is not run for a moment
breaks them all, whatever the program does; a busy program does not make this process late.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time

LATE_S = 0.05

# Standard input ends with the process that started it, however that ended.
_CODE = f"""
import select, sys, time
due = time.monotonic() + 0.005
while not select.select([sys.stdin], [], [], 0.005)[0]:
    now = time.monotonic()
    if now - due > {LATE_S}:
        print(now, flush=True)
    due = now + 0.005
"""


class Heartbeat:
    """The process; `watch` begins to watch, `missed` says whether the machine stood still since then."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _CODE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        assert self._process.stdout is not None
        self._pipe = self._process.stdout.fileno()
        os.set_blocking(self._pipe, False)
        self._begun = time.monotonic()
        self._stops: list[float] = []

    def watch(self) -> None:
        """From now on."""
        self._begun = time.monotonic()

    def missed(self) -> bool:
        """Whether the machine stood still for `LATE_S` since `watch`."""
        # It may be about to tell of the present moment.
        time.sleep(0.05)
        try:
            text = os.read(self._pipe, 1 << 20).decode()
        except BlockingIOError:
            text = ""
        self._stops += [float(line) for line in text.split()]
        return any(stop > self._begun for stop in self._stops)

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()
