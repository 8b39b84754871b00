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

_CODE = f"""
import time
while True:
    due = time.monotonic() + 0.005
    time.sleep(0.005)
    late = time.monotonic() - due
    if late > {LATE_S}:
        print(time.monotonic(), flush=True)
"""


class Heartbeat:
    """The process; `since` begins to watch, `missed` says whether the machine stood still since then."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _CODE], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, start_new_session=True
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
