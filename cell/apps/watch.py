"""Where the devices are and how they are, in lines of at most 80 columns, for `cell watch`.

`cell watch`: where the devices are and what goes on, read only, also while another process runs the cell.

What can be seen beside another user: an arm of Universal Robots, which serves several clients, and the feedback of a
vehicle on a SocketCAN bus, which anybody may hear. A serial line has one user: such a device is asked only when nobody
else has it, and when the person says that nobody else shall have it meanwhile. What runs is told by its journal."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cell.config.cell_config import CellConfig, example_addresses
from cell.devices.assembly import connect_one
from cell.devices.lock import CellLock, who_holds
from cell.motion.kinematics import arm_kinematics
from cell.run.folder import awaited_word, is_going, list_runs
from drivers.clock import Clock
from drivers.errors import CellError
from drivers.interfaces import ArmState, RailState, VehicleState
from statemachine.journal import JournalError, read

LABEL = 9
NEAR_DEG = 5.0
"""A joint that is nearer to its limit is marked."""


def arm_lines(state: ArmState | None, limits: tuple[Sequence[float], Sequence[float]], why: str = "") -> list[str]:
    """The arm's safety state, its flange (mm, deg of the rotation vector, arm base), joints beside `limits` in rad."""
    if state is None:
        return [f"{'arm':<{LABEL}}{why or 'tells nothing'}"]
    moves = "moves" if state.moving else "stands"
    control = "" if state.controlled else ", no control program"
    position = "  ".join(f"{axis} {1e3 * v:.1f}" for axis, v in zip("xyz", state.flange[:3], strict=True))
    turn = "  ".join(f"{np.degrees(v):.1f}" for v in state.flange[3:])
    joints, low, high = (np.degrees(np.asarray(v)) for v in (state.joints, *limits))
    near = np.minimum(joints - low, high - joints) < NEAR_DEG
    values = "".join(f"{v:>10.2f}{'!' if n else ' '}" for v, n in zip(joints, near, strict=True))
    return [
        f"{'arm':<{LABEL}}safety {state.safety.value}, {moves}{control}",
        f"{'':<{LABEL}}flange {position} mm  rotation {turn} deg",
        f"{'  joint':<{LABEL}}" + "".join(f"{f'j{k}':>10} " for k in range(1, 7)),
        f"{'  deg':<{LABEL}}{values}",
        f"{'  limits':<{LABEL}}" + "".join(f"{f'{a:.0f}…{b:.0f}':>10} " for a, b in zip(low, high, strict=True)),
        f"{'  pins':<{LABEL}}inputs {state.digital_inputs:#06x}   outputs {state.digital_outputs:#06x}",
    ]


def rail_lines(state: RailState | None, travel: tuple[float, float], why: str = "") -> list[str]:
    """The rail's place in its travel (m) and its switches."""
    low, high = (1e3 * v for v in travel)
    if state is None:
        return [f"{'rail':<{LABEL}}{why or 'tells nothing'}"]
    homed = "homed" if state.homed else "NOT HOMED"
    left, right = ("pressed" if pressed else "free" for pressed in (state.left_switch, state.right_switch))
    return [
        f"{'rail':<{LABEL}}{homed}, {'moves' if state.moving else 'stands'} at {1e3 * state.position:.3f} mm, "
        f"travel {low:.0f} to {high:.0f} mm",
        f"{'':<{LABEL}}switches: left {left}, right {right}",
    ]


def vehicle_lines(state: VehicleState | None, why: str = "") -> list[str]:
    """The vehicle's brake, speed, emergency stop and what troubles it."""
    if state is None:
        return [f"{'vehicle':<{LABEL}}{why or 'tells nothing'}"]
    brake = {None: "brake not known", True: "braked", False: "brake open"}[state.braked]
    stop = "EMERGENCY STOP" if state.emergency_stop else "no emergency stop"
    volts = "" if state.battery_volts is None else f", {state.battery_volts:.1f} V"
    speed = f"{1e3 * state.speed:.0f} mm/s, {np.degrees(state.yaw_rate):.1f} deg/s"
    first = f"{'vehicle':<{LABEL}}{brake}, {stop}, {speed}{volts}"
    return [first, *(f"{'':<{LABEL}}{trouble}" for trouble in (*state.trouble, *state.warnings))]


WATCHED = ("arm", "rail", "vehicle")
SHARED_BUSES = ("socketcan", "udp_multicast")
OLD_S = 1.0
"""Of the wall: an older reading is not shown."""
AGAIN_S = 5.0
"""After which a device that could not be reached is tried again."""
RAIL_S, RUN_S = 0.3, 0.5
LOG_LINES = 3


def shared(config: CellConfig, name: str) -> bool:
    """Whether this device can be listened to while another program uses it."""
    record, make = config.device(name), config.make(name).name
    if name == "arm":
        return make == "ur"
    return name == "vehicle" and make == "agilex" and getattr(record, "interface", "") in SHARED_BUSES


@dataclass(eq=False)
class _Watched:
    """One device: how it is connected, the connection, and the newest that it told."""

    connect: Callable[[], object]
    device: Any = None
    state: Any = None
    why: str = ""
    tried: float = field(default=-AGAIN_S)
    asked: float = 0.0


class CellWatch:
    """The devices of `config` and the runs in `runs`; made by `watching`."""

    def __init__(self, config: CellConfig, runs: Path, devices: dict[str, _Watched], undo: ExitStack) -> None:
        self._config, self._runs, self._devices, self._undo = config, runs, devices, undo
        self._rate = config.cell.time_scale
        limits = arm_kinematics(config.arm.model, None).limits
        self._limits = limits.lower, limits.upper
        self._told: list[str] = []
        self._read = -RUN_S

    def lines(self) -> list[str]:
        """What there is to see now, at most 80 columns wide as far as that is ours."""
        for name, watched in self._devices.items():
            self._look(name, watched)
        arm, rail, vehicle = (self._devices[name] for name in WATCHED)
        if time.monotonic() - self._read >= RUN_S:
            self._read = time.monotonic()
            self._told = run_lines(self._runs)
        return [
            f"watching cell {self._config.cell.name}; nothing is set, started or ended",
            "",
            *arm_lines(arm.state, self._limits, arm.why),
            *rail_lines(rail.state, self._config.rail.travel, rail.why),
            *vehicle_lines(vehicle.state, vehicle.why),
            "",
            *self._told,
        ]

    def _look(self, name: str, watched: _Watched) -> None:
        now = time.monotonic()
        try:
            if watched.device is None:
                if watched.why and now - watched.tried < AGAIN_S:
                    return
                watched.tried = now
                watched.device = watched.connect()
                self._undo.callback(watched.device.close)
            if name != "rail":
                watched.state = watched.device.state(OLD_S * self._rate)
            elif now - watched.asked >= RAIL_S:
                watched.asked = now
                watched.state = watched.device.state()
            watched.why = ""
        except CellError as error:
            watched.state, watched.why = None, str(error)


@contextmanager
def watching(config: CellConfig, runs: Path, whole: bool, given: bool = True) -> Iterator[CellWatch]:
    """Look at the cell; with `whole` also what has one user only, which nobody else can use then.

    No device is asked where the configuration is not one that somebody has `given`.

    Raises `InterlockError` when another process has a device that is to be looked at alone.
    """
    clock = Clock(config.cell.time_scale)
    devices: dict[str, _Watched] = {}
    with ExitStack() as undo:
        for name in WATCHED:
            record = config.device(name)
            connect = partial(connect_one, config, name, clock, look=True)
            if not given:
                connect = partial(_not_asked, "there is no cell.toml here; -c names your configuration")
            elif any(text.startswith(f"{name}.") for text in example_addresses(config)):
                connect = partial(_not_asked, "its address is the example's, where no device is")
            elif not shared(config, name) and not whole:
                connect = partial(_alone, name, record.held)
            elif not shared(config, name):
                undo.enter_context(CellLock(config, (name,)))
            devices[name] = _Watched(connect)
        yield CellWatch(config, runs, devices, undo)


def _not_asked(why: str) -> Any:
    raise CellError(why)


def _alone(name: str, address: str) -> Any:
    holder = who_holds(name, address)
    raise CellError(f"not looked at, its line has one user: {holder or 'nobody now, --all takes it'}")


def run_lines(runs: Path) -> list[str]:
    """What goes on in the folder of runs: the run, its step, what it waits for, and its newest words."""
    going = [folder for folder in list_runs(runs)[-5:] if is_going(folder)]
    if not going:
        return [f"{'run':<{LABEL}}nothing goes on in {runs}"]
    folder = going[-1]
    try:
        record = read(folder)
        waits = awaited_word(folder)
    except (JournalError, CellError) as error:
        return [f"{'run':<{LABEL}}{folder.name}: {error}"]
    info = record.run.info
    what = " ".join(str(info[key]) for key in ("kind", "job", "moved") if info.get(key))
    lines = [f"{'run':<{LABEL}}{folder.name}, {what}, for {time.time() - record.run.started:.0f} s"]
    if record.steps:
        step = record.steps[-1]
        after = time.time() - step.started if step.ended is None else step.ended - step.started
        lines.append(f"{'step':<{LABEL}}{step.name}, attempt {step.attempt}: {step.state}, {after:.0f} s on the wall")
    if waits is not None:
        lines.append(f"{'waits':<{LABEL}}{waits}; `cell confirm` answers, `cell abort` ends it")
    return [*lines, *(f"{'':<{LABEL}}{line}" for line in _newest(folder / "run.log"))]


def _newest(log: Path) -> list[str]:
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - 4000))
            text = file.read().decode("utf-8", errors="replace")
    except OSError:
        return []
    return [line for line in text.splitlines() if line.strip()][-LOG_LINES:]
