"""`cell find`: what is plugged into this computer, and whether the configured addresses answer.

Nothing is sent but to addresses that the configuration names or a port that the user has asked: no broadcast, no
multicast, also not by looking up a name. Nothing moves and no setting changes. What Linux shows in /sys is read below
`root`. Odd states of it (no /sys, files that cannot be read) find nothing.
"""

import grp
import logging
import os
import re
import socket
import struct
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from cell.config.cell_config import DEVICES, CellConfig, find_config, load_config
from cell.devices.lock import who_holds
from cell.makes import make_of
from drivers.clock import Clock
from drivers.common.addresses import is_example
from drivers.errors import CellError, ConfigError
from drivers.interfaces import LinkStatistics
from drivers.make import DeviceConfig, RailConfig, Surroundings, of_make
from drivers.rail.tmcl.make import TmclRailConfig
from drivers.relay.make import OnBoard
from drivers.vehicle.health import can_interface

ROOT = Path("/")
_CAN_TYPE = "280"
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


DEADLINE_S = 0.5
"""For one answer, wall seconds."""
ARM_PORTS = {29999: "dashboard", 30001: "primary", 30004: "RTDE"}
_GVCP_PORT = 3956
_DISCOVERY = bytes.fromhex("42 01 0002 0000 0001")
"""Who are you, please answer: sent to one address, as GigE Vision allows."""
_DISCOVERED, _BEHIND_HEADER = 0x0003, 8
_MODEL, _SERIAL = slice(104, 136), slice(216, 232)
_TMCL_BAUD, _TMCL_ADDRESS = 9600, 1

NEXT = (
    "serial: plug the adapter in and look at `dmesg`; a USB hub or a cable without data lines shows nothing",
    "CAN: for an adapter with a kernel driver `ip link` shows can0; others are serial ports (slcan)",
    "cameras: a GigE camera is asked at its address only: write it into cell.toml (its maker's tool shows it)",
    "arm: its address is on the teach pendant under Settings, System, Network; `ping` it from here",
)
"""What to check where nothing was found."""


def find(path: Path | None, ports: Collection[str] = (), *, ask: bool = False, root: Path = ROOT) -> list[Found]:
    """What is there, then the configured devices, if there is a configuration. `ports` are asked whether a TMCL module
    answers, with `ask` every serial port that was found and is free."""
    config: CellConfig | None = None
    unread: list[Found] = []
    try:
        source = find_config(path, simulated=True)
        config = None if source is None else load_config(source)
    except ConfigError as error:
        unread = [Found("configuration", str(path or "cell.toml"), str(error), False)]
    local = serial_ports(root)
    asked = [*ports, *(port.where for port in local if ask and port.ok and port.where not in ports)]
    local += [ask_module(port, config) for port in asked]
    return [*local, *can_interfaces(root), *cameras(root), *unread, *(configured(config, root) if config else ())]


def ask_module(port: str, config: CellConfig | None) -> Found:
    """Ask a serial port for a TMCL module's version, with the rail's configured speed and address, else the usual.
    Where the configured rail is of another make, it is that one that is asked for."""
    from drivers.rail.tmcl.link import TmclLink

    busy = _held(port) or ("" if "://" in port else barred(port) or opened_by(port))
    if config is not None and not isinstance(config.rail, TmclRailConfig):
        kind = f"rail ({config.rail.driver})"
        return Found(kind, port, busy, False) if busy else _ask_rail(kind, port, config.rail)
    if busy:
        return Found("TMCL module", port, busy, False)
    rail = None if config is None else of_make(config.rail, TmclRailConfig)
    baud, address = (_TMCL_BAUD, _TMCL_ADDRESS) if rail is None else (rail.baud, rail.address)
    try:
        link = TmclLink("rail", port, address=address, motor=0, baud=baud, clock=Clock(), statistics=LinkStatistics())
        with closing(link):
            version = link.firmware()
    except CellError as error:
        return Found("TMCL module", port, str(error), False)
    return Found(
        "TMCL module", port, f"version {version}", True, f'[rail] url = "{port}", baud = {baud}, address = {address}'
    )


def _ask_rail(kind: str, port: str, record: RailConfig) -> Found:
    """Ask a serial port for the configured rail, by its own driver, which only looks."""
    make = make_of("rail", record.driver)
    try:
        rail = make.connect("rail", record.model_copy(update={record.ADDRESS: port}), Surroundings(Clock(), look=True))
        with closing(rail):
            state = rail.state()
    except CellError as error:
        return Found(kind, port, str(error), False)
    told = f"answers: at {1e3 * state.position:.2f} mm, {'homed' if state.homed else 'not homed'}"
    return Found(kind, port, told, True, f'[rail] {record.ADDRESS} = "{port}"')


def configured(config: CellConfig, root: Path = ROOT) -> list[Found]:
    """Whether something answers where the configuration says that the devices are; all are tried at once."""
    names = [name for name in DEVICES if not config.make(name).on_arm]

    def look(name: str) -> Found:
        record = config.device(name)
        state, ok = _probe(name, record, root)
        return Found(f"configured {name}", record.place, state, ok)

    with ThreadPoolExecutor(len(names)) as at_once:
        return list(at_once.map(look, names))


def _probe(name: str, record: DeviceConfig, root: Path) -> tuple[str, bool]:
    place = record.url if isinstance(record, OnBoard) else record.place
    if record.driver == "fixed":
        return "nothing to connect", True
    if held := who_holds(name, record.held):
        return f"in use by {held}", True
    if place.startswith("/dev/"):
        problem = barred(place) or opened_by(place, root)
        return problem or "there, and this user may open it", not problem
    if getattr(record, "interface", "") == "socketcan":
        there = (root / "sys/class/net" / place).exists()
        if there and (answer := record.answers()) is not None:
            return answer
        return ("there" if there else f"no interface {place}: see `ip link`"), there
    return _look_at_host(name, record, place)


def _look_at_host(name: str, record: DeviceConfig, place: str) -> tuple[str, bool]:
    """The same of a device that is reached over the network."""
    host, port = _host_and_port(place)
    if not host:
        return "nothing to ask at such an address; `cell diag` connects to it", True
    if is_example(host):
        return "an example, which nobody has: write your own", False
    if host.endswith(".local"):
        return "not asked: to look up such a name is a multicast. Write its IPv4 address", False
    if record.driver == "ur":
        return _look_at_arm(host)
    if record.driver == "gige":
        answer = gige_camera(host)
        return answer or f"no GigE Vision camera answers within {DEADLINE_S} s: see its power and its address", bool(
            answer
        )
    if port is None:
        return "nothing to ask at such an address; `cell diag` connects to it", True
    if (answers := record.answers()) is not None:
        return answers
    problem = _try_port(host, port)
    if problem and DEVICES[name] == "camera" and (answer := gige_camera(host)):
        return f'{problem}; but {answer}: driver = "gige", address = "{host}"', False
    return problem or "answers", not problem


def _look_at_arm(host: str) -> tuple[str, bool]:
    problems = {port: _try_port(host, port) for port in ARM_PORTS}
    silent = [f"{port} ({ARM_PORTS[port]}) {problem}" for port, problem in problems.items() if problem]
    if not silent:
        return "answers on " + ", ".join(map(str, ARM_PORTS)), True
    hint = "See that the arm is on and `ping` it"
    if len(silent) < len(ARM_PORTS):
        hint = "Switch these services on: Settings, Security, Services on the teach pendant"
    return f"{'; '.join(silent)}. {hint}", False


def _try_port(host: str, port: int) -> str:
    """Why nobody takes a connection there; "" when somebody does. Nothing is sent over it."""
    try:
        socket.create_connection((host, port), timeout=DEADLINE_S).close()
    except TimeoutError:
        return f"no answer within {DEADLINE_S} s"
    except OSError as error:
        return f"{(error.strerror or str(error)).lower()}"
    return ""


def gige_camera(host: str, port: int = _GVCP_PORT) -> str:
    """Which GigE Vision camera answers at this address, and at no other; "" when none does."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.settimeout(DEADLINE_S)
        try:
            # Connected: answers of others are not taken, and without SO_BROADCAST no broadcast can leave.
            link.connect((host, port))
            link.send(_DISCOVERY)
            packet = link.recv(2048)
        except OSError:
            return ""
    told = packet[_BEHIND_HEADER:]
    if len(told) < _SERIAL.stop or struct.unpack_from(">HH", packet) != (0, _DISCOVERED):
        return ""
    model, serial = (told[part].split(b"\0")[0].decode("utf-8", "replace") for part in (_MODEL, _SERIAL))
    return f"a GigE Vision camera answers: {model} {serial}".rstrip()


def _host_and_port(place: str) -> tuple[str, int | None]:
    if place.startswith(("socket://", "rfc2217://")):
        split = urlsplit(place)
        return split.hostname or "", split.port
    if "://" in place or "/" in place:
        return "", None
    host, _, port = place.partition(":")
    return host, int(port) if port.isdigit() else None


def _held(port: str) -> str:
    place = os.path.realpath(port) if port.startswith("/") else port
    holders = (who_holds(name, place) for name in ("rail", "vehicle"))
    return next((f"in use by {held}: wait for its end" for held in holders if held), "")
