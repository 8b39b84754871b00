"""How this computer is: each check says whether the cell needs it, and the command that mends it.

Every cell asks for Python, room, clocks, timing and packages; its configured devices for ports, CAN interfaces and
libraries. Read from the system below `root`. No device is opened or asked.
"""

import ctypes
import os
import resource
import shutil
import sys
import time
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, NamedTuple

from packaging.requirements import Requirement

from cell.config.cell_config import DEVICES, CellConfig, beside, find_config, load_config, runs_folder
from cell.devices.diagnosis.finding import ROOT, barred, opened_by
from cell.run.folder import DISTRIBUTION, list_runs
from drivers.errors import ConfigError
from drivers.make import DeviceConfig
from drivers.vehicle.health import CanInterface, can_interface

State = Literal["ok", "wrong", "not needed"]


class DoctorCheck(NamedTuple):
    """`what` was looked at, what was `found`, and what a person types where it is wrong."""

    what: str
    state: State
    found: str
    mend: str = ""


def judged(what: str, problem: str, found: str, mend: str = "", *, needed: bool = True) -> DoctorCheck:
    """A check that is ok without a `problem`; with one it is wrong where it is `needed`, else told all the same."""
    if not problem:
        return DoctorCheck(what, "ok", found)
    return DoctorCheck(what, "wrong" if needed else "not needed", problem, mend)


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
    before = time.time() - time.monotonic()
    time.sleep(0.2)
    apart = abs(time.time() - time.monotonic() - before)
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


LEAST_BUFFER = 4_000_000
"""Bytes of a GigE camera's packets that the driver asks the system to keep."""


def link_checks(config: CellConfig, simulated: Collection[str], root: Path) -> Iterator[DoctorCheck]:
    """A row for each configured device that needs something of this computer; `simulated` ones need nothing."""
    for name in DEVICES:
        record, make = config.device(name), config.make(name)
        if name in simulated:
            yield DoctorCheck(name, "not needed", "is simulated")
            continue
        if missing := make.missing():
            yield _told(f"{name}, {make.name}", missing)
        if getattr(record, "interface", "") == "socketcan":
            yield can_check(name, record, can_interface(record.place))
        elif device := _file(record):
            problem = barred(device) or opened_by(device, root)
            what = f"{name}, port {device}"
            yield _told(what, problem) if problem else DoctorCheck(what, "ok", "may be opened")
        if make.name == "gige":
            yield _buffer_check(name, root)


def can_check(name: str, record: DeviceConfig, about: CanInterface | None) -> DoctorCheck:
    """A CAN interface of Linux against what the configuration says of the bus."""
    what, wanted = f"{name}, CAN {record.place}", int(getattr(record, "bitrate", 500_000))
    up = f"sudo ip link set {record.place} up type can bitrate {wanted}"
    if about is None:
        return DoctorCheck(what, "wrong", "there is no such interface, or no `ip` to ask", f"plug the adapter in; {up}")
    if not about.up:
        return DoctorCheck(what, "wrong", "is down", up)
    if about.bitrate not in (None, wanted):
        found = f"runs at {(about.bitrate or 0) / 1e3:g} kbit/s, the configuration says {wanted / 1e3:g} kbit/s"
        return DoctorCheck(what, "wrong", found, f"sudo ip link set {record.place} down; {up}")
    return DoctorCheck(what, "ok", "up" if about.bitrate is None else f"up, {about.bitrate / 1e3:g} kbit/s")


def _file(record: DeviceConfig) -> str:
    """The device file that a record names, "" where it is reached otherwise."""
    place = record.place.partition("@")[0]
    return place if place.startswith("/dev/") else ""


def _buffer_check(name: str, root: Path) -> DoctorCheck:
    try:
        most = int((root / "proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        return DoctorCheck(f"{name}, receive buffer", "not needed", "not told by this system")
    problem = f"at most {most} bytes, {LEAST_BUFFER} are wanted" if most < LEAST_BUFFER else ""
    mend = f"sudo sysctl -w net.core.rmem_max={LEAST_BUFFER}"
    return judged(f"{name}, receive buffer", problem, f"up to {most} bytes", mend)


def _told(what: str, problem: str) -> DoctorCheck:
    """A problem in words that end with what mends it, behind a colon."""
    found, _, mend = problem.partition(": ")
    return DoctorCheck(what, "wrong", found, mend)


ALWAYS = ""
"""The name of what is asked for without an extra."""

OWN = ("cell", "drivers", "statemachine", "sim_backends")
"""The top-level packages of this program. Python knows one package by a name, whoever installed it."""


def shadow_check(
    installed: Callable[[], Mapping[str, list[str]]] = packages_distributions, root: Path = Path(__file__).parents[2]
) -> DoctorCheck:
    """Whether another distribution or another folder has a package of the same name as one of ours. `installed` gives
    the distributions by package; `root` is the folder that holds our packages."""
    by_name = installed()
    others = {name: sorted(set(by_name.get(name, ())) - {DISTRIBUTION}) for name in OWN}
    for name, distributions in others.items():
        if distributions:
            problem = f"{' and '.join(distributions)} installs a package {name} as well, and one hides the other"
            return judged("package names", problem, "", f"pip uninstall {' '.join(distributions)}; pip install -e .")
    for name in OWN:
        spec = find_spec(name)
        if spec is not None and spec.origin and Path(spec.origin).parents[1] != root:
            problem = f"{name} is imported from {spec.origin}, not from {root}"
            return judged("package names", problem, "", "start Python in another folder, or unset PYTHONPATH")
    return DoctorCheck("package names", "ok", f"{', '.join(OWN)} are this program's")


def asked_for(extras: Iterable[str]) -> dict[str, list[Requirement]]:
    """What is asked for always and with each of these extras: by the checkout's pyproject.toml, which is newer than
    what was noted when it was installed, else by the installed distribution. `PackageNotFoundError` without either."""
    project = Path(__file__).parents[2] / "pyproject.toml"
    if project.is_file():
        table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
        groups = table.get("optional-dependencies", {})
        lines = {ALWAYS: table["dependencies"], **{extra: groups.get(extra, []) for extra in extras}}
        asked = {extra: map(Requirement, wanted) for extra, wanted in lines.items()}
        return {extra: [o for o in wanted if not o.marker or o.marker.evaluate()] for extra, wanted in asked.items()}
    found: dict[str, list[Requirement]] = {extra: [] for extra in (ALWAYS, *extras)}
    for requirement in map(Requirement, requires(DISTRIBUTION) or ()):
        marker = requirement.marker
        fitting = [extra for extra in found if marker is None or marker.evaluate({"extra": extra})]
        # What is always asked for fits every extra as well, and stands first.
        for extra in fitting[:1]:
            found[extra].append(requirement)
    return found


def package_checks(
    needed: Iterable[str], others: Iterable[str], installed: Callable[[str], str] = version
) -> list[DoctorCheck]:
    """A row for all that is always asked for, and one for each extra: those that the cell needs, and others."""
    needed, others = list(needed), list(others)
    try:
        asked = asked_for([*needed, *others])
    except PackageNotFoundError:
        return [DoctorCheck("packages", "wrong", f"{DISTRIBUTION} is not installed", "pip install -e .")]
    rows = []
    for extra, requirements in asked.items():
        if not requirements:
            continue
        problems, wanted = [], []
        for requirement in requirements:
            if why := _wrong(requirement, installed):
                problems.append(why)
                wanted.append(f"'{requirement.name}{requirement.specifier}'")
        name = f"packages of the extra {extra}" if extra else "packages"
        mend = f"pip install {' '.join(wanted)}"
        fine = f"{len(requirements)} as {DISTRIBUTION} asks for them"
        rows.append(judged(name, "; ".join(problems), fine, mend, needed=extra in needed or extra == ALWAYS))
    return rows


def _wrong(requirement: Requirement, installed: Callable[[str], str]) -> str:
    try:
        here = installed(requirement.name)
    except PackageNotFoundError:
        return f"{requirement.name} is not installed"
    if requirement.specifier.contains(here, prereleases=True):
        return ""
    return f"{requirement.name} is {here}, asked for is {requirement.specifier}"


EXTRA_OF_DRIVER = {"canopen": "canopen"}
"""Extras of this program that a device's driver needs."""
OTHER_EXTRAS = ("step", "canopen", "modbus")


def examine_computer(path: Path | None, root: Path = ROOT) -> list[DoctorCheck]:
    """How this computer is, for the cell that is configured, or for simulated ones where none is."""
    source = find_config(path, simulated=True)
    rows: list[DoctorCheck] = []
    config = None
    if source is not None:
        try:
            config = load_config(source)
            rows.append(DoctorCheck("configuration", "ok", str(source)))
        except ConfigError as error:
            rows.append(DoctorCheck("configuration", "wrong", " ".join(str(error).split()), f"cell check -c {source}"))
    whole = config is None or bool(config.cell.truth)
    simulated = tuple(DEVICES) if whole or config is None else config.cell.sim
    real = [name for name in DEVICES if name not in simulated]
    needed = set() if config is None else {EXTRA_OF_DRIVER.get(config.device(name).driver, "") for name in real} - {""}
    rows += [python_check(), *package_checks(sorted(needed), [name for name in OTHER_EXTRAS if name not in needed])]
    rows.append(shadow_check())
    rows.append(disk_check(runs_folder(source) if source is not None else beside(source) / "runs"))
    needed_here = bool(real)
    rows += [date_check(clock_synchronised(), needed_here), clock_check(root, needed_here)]
    rows.append(scheduling_check(root, needed_here))
    if config is None:
        found = "no cell.toml here: simulated cells need no port" if source is None else "see configuration first"
        rows.append(DoctorCheck("devices", "not needed", found))
    elif whole:
        rows.append(DoctorCheck("devices", "not needed", "all are simulated"))
    else:
        rows += link_checks(config, simulated, root)
    return [*rows, browser_check()]
