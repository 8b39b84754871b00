"""`cell find`: what is plugged into this computer, and whether the configured addresses answer.

Nothing is sent but to addresses that the configuration names or a port that the user has asked: no broadcast, no
multicast, also not by looking up a name. Nothing moves and no setting changes.
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

from cell.config.cell_config import DEVICES, CellConfig, find_config, load_config
from cell.devices.diagnosis.local_devices import ROOT, Found, barred, cameras, can_interfaces, opened_by, serial_ports
from cell.devices.lock import who_holds
from cell.makes import make_of
from drivers.clock import Clock
from drivers.common.addresses import is_example
from drivers.errors import CellError, ConfigError
from drivers.interfaces import LinkStatistics
from drivers.make import DeviceConfig, RailConfig, Surroundings, of_make
from drivers.rail.tmcl.make import TmclRailConfig
from drivers.relay.make import OnBoard

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
    """What is there, then the configured devices, if there is a configuration.

    `ports` are asked whether a TMCL module answers, with `ask` every serial port that was found and is free.
    """
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

    Where the configured rail is of another make, it is that one that is asked for.
    """
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
