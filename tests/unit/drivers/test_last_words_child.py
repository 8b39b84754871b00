"""Promises of `drivers.last_words_child`."""

import os
import signal
import subprocess
import sys
import time

import pytest

from drivers.last_words_child import FROZEN_S, LOOK_S, Owner

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
print(before == os.SCHED_RR, os.sched_getscheduler(0) == os.SCHED_OTHER)"""


def test_what_spins_in_real_time_loses_the_right_to_it():
    done = subprocess.run([sys.executable, "-c", SPIN], capture_output=True, text=True, timeout=30.0, check=True)
    raised, lowered = done.stdout.split()
    if raised == "False":
        pytest.skip("this system lets nobody run in real time")
    assert lowered == "True"


def test_an_owner_that_waits_for_a_processor_is_late_one_that_was_stopped_is_frozen():
    """On one core, beside a process that goes first."""
    spin = [sys.executable, "-c", "while True: pass"]
    core = min(os.sched_getaffinity(0))
    with subprocess.Popen(spin) as first, subprocess.Popen(spin) as waits:
        try:
            for process in (first, waits):
                os.sched_setaffinity(process.pid, {core})
            os.sched_setscheduler(waits.pid, os.SCHED_IDLE, os.sched_param(0))
            assert not freezes(waits.pid, 4 * FROZEN_S)
            waits.send_signal(signal.SIGSTOP)
            first.kill()
            assert freezes(waits.pid, 4 * FROZEN_S)
        finally:
            first.kill()
            waits.kill()


def freezes(pid: int, seconds: float) -> bool:
    """Whether an owner that beats no more counts as frozen within so many seconds."""
    owner, begun, frozen = Owner(pid), time.monotonic(), False
    owner.beat()
    while not frozen and time.monotonic() - begun < seconds:
        time.sleep(LOOK_S)
        frozen = owner.frozen()
    return frozen
