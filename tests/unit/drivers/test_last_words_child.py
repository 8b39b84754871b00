"""Promises of `drivers.last_words_child`."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.wire


SPIN = """
import os, sys, threading, time
from drivers.last_words_child import raise_priority
def spin():
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        pass
raise_priority()
before = os.sched_getscheduler(0)
thread = threading.Thread(target=spin)
thread.start()
thread.join()
print(before == os.SCHED_RR, os.sched_getscheduler(0) == os.SCHED_OTHER)
"""


def test_what_spins_in_real_time_loses_the_right_to_it() -> None:
    done = subprocess.run([sys.executable, "-c", SPIN], capture_output=True, text=True, timeout=30.0, check=True)
    raised, lowered = done.stdout.split()
    if raised == "False":
        pytest.skip("this system lets nobody run in real time")
    assert lowered == "True"
