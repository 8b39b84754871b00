"""How an arm's stream of states comes, and what its controller tells of supply and temperatures.

A connection of its own that only reads: an output recipe sets nothing. Limits that the maker does not publish are ours.
Source: the maker's RTDE guide, version 2; docs/reference/protocols.md, section 1.
"""

import struct
from dataclasses import dataclass

import numpy as np

from drivers.arm.faults import fault
from drivers.arm.link import PORT, RATE_HZ, VERSION, RtdeLink
from drivers.clock import Clock
from drivers.errors import DeadlineError, NotConnectedError
from drivers.interfaces import Reading, Vector

_VARIABLES = "timestamp,actual_main_voltage,joint_temperatures"
_TYPES = b"DOUBLE,DOUBLE,VECTOR6D"
_PACKET = struct.Struct(">Bdd6d")
_TIMEOUT_S = 3.0
"""On the wall, beside the time of watching."""
LATEST_PERIOD_S = 0.010
"""A fifth of what the arm smooths its targets over: they go through the same network and computer as its states."""
MOST_MISSING = 1.0
MOST_DRIFT_PPM = 1000.0
"""More than a second's look gets wrong; crystals are within 100 ppm."""
SUPPLY_V = (43.2, 52.8)
"""48 V and a tenth of it."""
HOTTEST_DEG_C = 75.0
_NETWORK = "Use a cable of its own, no Wi-Fi and no switch under load, and end programs that keep this computer busy."


@dataclass(frozen=True, eq=False)
class Watched:
    """What came: host times of arrival (n,) in s of the clock, the arm's own times (n,) in s, last V and °C (6,)."""

    arrived: Vector
    measured: Vector
    volts: float
    temperatures: tuple[float, ...]


def examine(name: str, address: str, clock: Clock, seconds: float) -> list[Reading]:
    """Watch the arm at `address`; errors as of `drivers.arm.link.latch_clock`."""
    try:
        with RtdeLink(address, clock, clock.wall(seconds) + _TIMEOUT_S) as link:
            watched = _watch(name, link, clock, seconds)
    except TimeoutError as error:
        raise DeadlineError(name, f"its states on port {PORT} did not come for {seconds:g} s") from error
    except OSError as error:
        raise NotConnectedError(
            name, f"its states cannot be read at {address}:{PORT}: {error}. See that the arm is on and connected."
        ) from error
    return readings(watched, judge_times=clock.rate <= 1.0)


def _watch(name: str, link: RtdeLink, clock: Clock, seconds: float) -> Watched:
    states = struct.pack(">d", RATE_HZ) + _VARIABLES.encode()
    for what, kind, payload in (
        ("RTDE version 2", "V", struct.pack(">H", VERSION)),
        (f"{_VARIABLES} in its states", "O", states),
        ("a start of its states", "S", b""),
    ):
        reply = link.ask(kind, payload)
        if not reply[:1].strip(b"\0") or (kind == "O" and reply[1:] != _TYPES):
            raise fault(name, "arm.refused", f"it does not give {what}")
    arrived: list[float] = []
    measured: list[float] = []
    begun = clock.now()
    while len(arrived) < 3 or clock.now() - begun < seconds:
        packet = link.receive("U")
        if len(packet) != _PACKET.size:
            raise fault(name, "arm.refused", f"it sends states of {len(packet)} bytes instead of {_PACKET.size}")
        _, device, volts, *temperatures = _PACKET.unpack(packet)
        arrived.append(clock.now())
        measured.append(device)
    return Watched(np.array(arrived), np.array(measured), volts, tuple(temperatures))


def readings(watched: Watched, *, judge_times: bool) -> list[Reading]:
    """Figures of what came. Without `judge_times`, on a clock that is not the wall's, times have no limits."""
    gaps = np.diff(watched.measured)
    nominal = float(np.median(gaps))
    missing = float(np.maximum(np.round(gaps / nominal) - 1.0, 0.0).sum()) if nominal > 0 else np.nan
    period = float(np.percentile(np.diff(watched.arrived), 99))
    return [
        Reading("state period by its clock, median", 1e3 * nominal, "ms"),
        Reading(
            "state period on arrival, p99", 1e3 * period, "ms",
            most=1e3 * LATEST_PERIOD_S if judge_times else None, remedy=_NETWORK,
        ),
        Reading(
            "states missing", 100.0 * missing / (len(gaps) + missing), "%",
            most=MOST_MISSING if judge_times else None, remedy=_NETWORK,
        ),
        Reading(
            "clock against this computer's", 1e6 * drift(watched), "ppm",
            least=-MOST_DRIFT_PPM if judge_times else None, most=MOST_DRIFT_PPM if judge_times else None,
            remedy="Look again while the computer is idle; if it stays, stop whatever sets this computer's clock, and "
            "sweep by the rail.",
        ),
        Reading(
            "supply", watched.volts, "V", *SUPPLY_V,
            remedy="Measure the 48 V supply in the control box and what feeds it.",
        ),
        Reading(
            "hottest joint", max(watched.temperatures), "°C",
            most=HOTTEST_DEG_C, remedy="Let the arm rest, and lower speed or payload.",
        ),
    ]  # fmt: skip


def drift(watched: Watched) -> float:
    """By which part the arm's clock is faster than the host's: from the promptest states of the first and last third. A
    state can only come late, so the promptest of many are the ones whose times compare."""
    third = max(1, len(watched.arrived) // 3)
    late = watched.arrived - watched.measured
    first, last = int(np.argmin(late[:third])), len(late) - third + int(np.argmin(late[-third:]))
    apart = float(watched.arrived[last] - watched.arrived[first])
    return float(late[first] - late[last]) / apart if apart > 0 else np.nan
