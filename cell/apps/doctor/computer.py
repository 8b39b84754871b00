"""What every cell asks of its computer: Python, room, clocks, timing, a browser. Read from the system below `root`."""

from __future__ import annotations

import ctypes
import os
import resource
import shutil
import sys
import time
from pathlib import Path

from cell.apps.doctor.check import DoctorCheck, judged
from cell.run.files.folder import list_runs

ROOM_BYTES = 2_000_000_000
RUN_BYTES = 40_000_000
"""What a run or a calibration writes, about."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox", "microsoft-edge", "brave-browser")
COARSE_CLOCKS = ("jiffies", "refined-jiffies", "acpi_pm", "hpet", "pit")
"""Clock sources that take a microsecond or more to read, or step by more than one."""
NAPS, NAP_S = 100, 0.001
LATE_S = 0.008
"""One period of an arm that is fed 125 times a second."""
STEP_S = 0.005
_UNSYNCHRONISED = 0x40


def python_check() -> DoctorCheck:
    """Python's version."""
    here = ".".join(map(str, sys.version_info[:3]))
    old = sys.version_info < (3, 11)
    return judged("Python", f"{here}, 3.11 or newer is needed" if old else "", here, "install Python 3.11")


def disk_check(runs: Path, wanted: int = ROOM_BYTES) -> DoctorCheck:
    """Room for runs and calibrations, `wanted` bytes, and whether they can be written."""
    folder = next(path for path in (runs, *runs.parents) if path.is_dir())
    if not os.access(folder, os.W_OK | os.X_OK):
        return DoctorCheck("disk", "wrong", f"{folder} cannot be written", f"sudo chown $USER {folder}")
    free = shutil.disk_usage(folder).free
    told = f"{free / 1e9:.1f} GB free at {folder}, about {free // RUN_BYTES} runs"
    oldest = list_runs(runs)[:1]
    mend = f"rm -r {oldest[0]}   (the oldest run; or make room elsewhere)" if oldest else "make room on that disk"
    return judged("disk", f"{told}; {wanted / 1e9:g} GB are wanted" if free < wanted else "", told, mend)


def date_check(synchronised: bool | None, needed: bool) -> DoctorCheck:
    """Whether the date is kept by a time server (None: not told): a calibration's age is told by it."""
    told = "kept by a time server"
    problem = "the date is kept by no time server; runs and calibrations may be dated wrongly"
    if synchronised is None:
        told = problem = "not told by this system"
    return judged("date (NTP)", "" if synchronised else problem, told, "sudo timedatectl set-ntp true", needed=needed)


def clock_synchronised() -> bool | None:
    """What the kernel says: `status` of adjtimex with nothing to set; None where it cannot be asked."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        # struct timex: `modes` (padded) 0, which only reads; offset, freq, maxerror and esterror; then `status`.
        buffer = (ctypes.c_long * 32)()
        if libc.adjtimex(ctypes.byref(buffer)) < 0:
            return None
        status = ctypes.cast(buffer, ctypes.POINTER(ctypes.c_int))[5 * ctypes.sizeof(ctypes.c_long) // 4]
    except (OSError, AttributeError):
        return None
    return not status & _UNSYNCHRONISED


def clock_check(root: Path, needed: bool) -> DoctorCheck:
    """The clock that everything is stamped with: its source, and whether date and clock go together now."""
    try:
        source = (root / "sys/devices/system/clocksource/clocksource0/current_clocksource").read_text().strip()
    except OSError:
        source = "not told"
    apart = _apart()
    told = f"source {source}, steps by {1e9 * _tick():.0f} ns"
    if source in COARSE_CLOCKS:
        mend = "boot without clocksource=… and notsc on the kernel's command line; see `dmesg | grep -i clocksource`"
        return judged("clock", f"{told}: too coarse for stamps to a microsecond", told, mend, needed=needed)
    if apart > STEP_S:
        problem = f"date and clock went {1e3 * apart:.0f} ms apart within 0.2 s: something sets the date by steps"
        return judged("clock", problem, told, "systemctl status systemd-timesyncd chrony ntp", needed=needed)
    return judged("clock", "", told)


def _tick() -> float:
    begun = time.monotonic()
    while (now := time.monotonic()) == begun:
        pass
    return now - begun


def _apart() -> float:
    before = time.time() - time.monotonic()
    time.sleep(0.2)
    return abs(time.time() - time.monotonic() - before)


def scheduling_check(root: Path, needed: bool, most: float = LATE_S) -> DoctorCheck:
    """How late a sleeping thread wakes: devices that are fed by time cannot wait longer than a period, `most` s."""
    late = sorted(_nap() for _ in range(NAPS))
    p99 = late[int(0.99 * NAPS) - 1]
    right = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    kernel = "real-time kernel" if (root / "sys/kernel/realtime").exists() else "ordinary kernel"
    rights = f"{kernel}, real-time priorities up to {right} allowed (this program asks for none)"
    told = f"wakes {1e3 * p99:.2f} ms late (99 % of {NAPS} naps); {rights}"
    mend = "end what else computes (`top`); sudo cpupower frequency-set -g performance"
    problem = f"{told}; at most {1e3 * most:g} ms are wanted" if p99 > most else ""
    return judged("scheduling", problem, told, mend, needed=needed)


def _nap() -> float:
    begun = time.monotonic()
    time.sleep(NAP_S)
    return time.monotonic() - begun - NAP_S


def browser_check() -> DoctorCheck:
    """A browser for the operator's screen and for the pages of runs; any other computer's does as well."""
    found = next((name for name in BROWSERS if shutil.which(name)), "")
    problem = "" if found else "none found; the pages of runs open on any other computer"
    return judged("browser", problem, found, "sudo apt-get install chromium", needed=False)
