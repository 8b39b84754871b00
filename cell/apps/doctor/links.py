"""What the configured devices ask of this computer: ports, CAN interface, libraries. No device is opened or asked."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from cell.apps.doctor.check import DoctorCheck, judged
from cell.config.cell_config import DEVICES, CellConfig
from cell.devices.diagnosis.local_devices import barred, opened_by
from cell.makes.records import DeviceConfig
from drivers.vehicle.can_interface import CanInterface, can_interface

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
