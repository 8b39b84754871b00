"""What is plugged into this computer: serial ports, CAN interfaces, cameras. Read from the system; nothing is opened.

What Linux shows in /sys is read below `root`. Odd states of it (no /sys, files that cannot be read) find nothing.
"""

from __future__ import annotations

import grp
import logging
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from drivers.vehicle.health import can_interface

ROOT = Path("/")
_CAN_TYPE = "280"
"""ARPHRD_CAN."""
_USB3_VISION = ("ef", "05")
"""Class and subclass of a USB interface."""
_ADAPTERS = ("pcan", "kvaser", "ixxat", "vector", "gs_usb", "canalystii", "usb2can")
"""Of python-can's interfaces those that look for adapters on this computer's buses; others ask the network."""


class Found(NamedTuple):
    """Something that is there or should be: what, where, how it is, whether it can be used, and what to write."""

    what: str
    where: str
    state: str
    ok: bool
    write: str = ""


def serial_ports(root: Path = ROOT, listed: Iterable[Any] | None = None) -> list[Found]:
    """Ports as pyserial lists them (`listed`: entries of its `comports`), and whether this user may open them."""
    if listed is None:
        from serial.tools import list_ports

        listed = list_ports.comports()
    found: list[Found] = []
    for port in sorted(listed, key=lambda port: str(port.device)):
        told = [
            str(word) for word in (port.description, port.manufacturer, port.serial_number) if word not in (None, "n/a")
        ]
        problem = barred(port.device) or opened_by(port.device, root)
        place = steady_name(port.device, root)
        found.append(
            Found(
                "serial port", port.device, problem or ", ".join(told) or "free", not problem, _serial_use(place, told)
            )
        )
    return found


def _serial_use(place: str, told: list[str]) -> str:
    rail, vehicle = f'[rail] url = "{place}"', f'[vehicle] interface = "slcan", channel = "{place}"'
    words = " ".join(told).lower()
    if "numato" in words:
        return f'[laser] driver = "numato", url = "{place}"'
    if re.search(r"trinamic|tmcm", words):
        return rail
    return vehicle if re.search(r"\bcan|slcan", words) else f"{rail}\nor {vehicle}"


def steady_name(device: str, root: Path = ROOT) -> str:
    """A link to the port that stays when others are plugged in; the port itself where there is none."""
    try:
        links = sorted((root / "dev/serial/by-id").iterdir())
    except OSError:
        return device
    same = (link for link in links if link.resolve().name == Path(device).name)
    return next((f"/dev/serial/by-id/{link.name}" for link in same), device)


def barred(device: str) -> str:
    """Why this user cannot open a device file, and what helps; "" when they can."""
    try:
        about = Path(device).stat()
    except FileNotFoundError:
        return "not there: plug it in, and see `dmesg` for what the system says of it"
    except OSError as error:
        return f"cannot be looked at: {error.strerror}"
    if os.access(device, os.R_OK | os.W_OK):
        return ""
    try:
        group = grp.getgrgid(about.st_gid).gr_name
    except KeyError:
        group = str(about.st_gid)
    return f"no permission: sudo usermod -aG {group} $USER, then log in again"


def opened_by(device: str, root: Path = ROOT) -> str:
    """Which other process has a device file open, as far as this user may see; "" when none is seen."""
    real = os.path.realpath(device)
    for handle in (root / "proc").glob("[0-9]*/fd/*"):
        try:
            pid = handle.parts[-3]
            if str(handle.readlink()) == real and pid != str(os.getpid()):
                name = (root / "proc" / pid / "comm").read_text(encoding="utf-8", errors="replace").strip()
                return f"in use by process {pid} ({name}): end that first"
        except OSError:
            continue
    return ""


def can_interfaces(root: Path = ROOT) -> list[Found]:
    """Linux' CAN interfaces with state and bit rate, then the adapters that python-can's drivers see."""
    return [*_socketcan(root), *_adapters()]


def _socketcan(root: Path) -> Iterator[Found]:
    for folder in _entries(root / "sys/class/net"):
        if _text(folder / "type") != _CAN_TYPE:
            continue
        name = folder.name
        about = can_interface(name)
        up = about.up if about is not None else _text(folder / "operstate") != "down"
        rate = about.bitrate if about is not None else None
        words = [about.state] if about is not None and about.state else []
        words += [f"{rate / 1e3:g} kbit/s"] if rate else []
        state = ", ".join(words) or "up"
        if not up:
            state = f"down: sudo ip link set {name} up type can bitrate {rate or 500_000}"
        bitrate = f', bitrate = "{rate / 1e3:g} kbit/s"' if rate else ""
        yield Found("CAN interface", name, state, up, f'[vehicle] interface = "socketcan", channel = "{name}"{bitrate}')


def _adapters() -> Iterator[Found]:
    import can

    # Drivers that are not installed say so in the log, each of them.
    log = logging.getLogger("can")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        configs: list[Any] = list(can.detect_available_configs(_ADAPTERS))
    except Exception as error:  # whatever a vendor's library does, the rest is still listed
        configs = []
        yield Found("CAN interface", "adapters", f"python-can could not look: {error}", False)
    finally:
        log.setLevel(level)
    for config in configs:
        interface, channel = config["interface"], config["channel"]
        write = f'[vehicle] interface = "{interface}", channel = "{channel}"'
        yield Found("CAN interface", f"{interface}:{channel}", "seen by its driver", True, write)


def cameras(root: Path = ROOT) -> list[Found]:
    """Cameras on this computer: V4L2 devices, and USB3 Vision ones by their interface class."""
    return [*_v4l2(root), *_usb3(root)]


def _v4l2(root: Path) -> Iterator[Found]:
    for folder in _entries(root / "sys/class/video4linux"):
        # A camera's further nodes give other data than pictures.
        if _text(folder / "index") not in ("0", ""):
            continue
        device = f"/dev/{folder.name}"
        problem = barred(device)
        state = problem or _text(folder / "name") or "free"
        yield Found("camera", device, state, not problem, f'[scan_camera] driver = "v4l2", device = "{device}"')


def _usb3(root: Path) -> Iterator[Found]:
    for folder in _entries(root / "sys/bus/usb/devices"):
        if (_text(folder / "bInterfaceClass"), _text(folder / "bInterfaceSubClass")) != _USB3_VISION:
            continue
        if _text(folder / "bInterfaceProtocol") != "00":
            continue
        usb = folder.parent / folder.name.partition(":")[0]
        serial = _text(usb / "serial")
        told = " ".join(word for word in (_text(usb / "manufacturer"), _text(usb / "product"), serial) if word)
        guid = serial if re.fullmatch(r"[0-9A-Fa-f]{12}", serial) else "GUID"
        hint = "" if guid == serial else "; its GUID is shown by `arv-tool-0.8`, behind the maker's name and a dash"
        yield Found(
            "camera", f"USB {usb.name}", f"USB3 Vision: {told}{hint}", True,
            f'[scan_camera] driver = "usb3", guid = "{guid}"',
        )  # fmt: skip


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
