"""What each device did along the time of a run, by its record: where it moved, was lit, or took pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from cell.run.record.file import CAMERAS, FILE, missing
from cell.run.record.reading import messages
from drivers.errors import CellError

LANES = {
    "vehicle": "drives", "arm": "moves", "rail": "moves", "laser": "is lit", "scan_camera": "takes pictures",
    "target_camera": "takes pictures", "claw": "is told",
}  # fmt: skip
"""Devices in the order in which they are drawn, and what a bar of each says."""
MOVING = 1e-3
"""Rad/s of a joint, m/s or rad/s of the vehicle, above which it moves."""
RAIL_M_S = 0.04
"""How fast the rail goes where no speed is told: as `rail.max_speed` is shipped."""
SWITCH_S = 1.0
"""What the rail takes over its reference switch."""
APART_S = 0.5
"""Pictures farther apart are of two looks."""
SHORTEST_S = 0.02
"""A bar of an instant, such as one picture, is so long."""

State: TypeAlias = Mapping[str, object]


class Activity(NamedTuple):
    """A device was busy from `begin` to `end`, s since the first step began. `first` and `last` are its states then."""

    device: str
    begin: float
    end: float
    pictures: int = 0
    first: State | None = None
    last: State | None = None

    @property
    def words(self) -> str:
        """For people."""
        many = f", {self.pictures}" if self.pictures else ""
        return f"{self.device} {LANES[self.device]}{many}, {self.end - self.begin:.2f} s"


@dataclass(frozen=True)
class _Told:
    at: float
    state: State


def activities(folder: Path, rate: float = 1.0) -> list[Activity]:
    """What the devices did in the run in `folder`, in the order of the devices and of the time; empty where no record
    tells it. The cell went `rate` times as fast as the record's time."""
    if missing() or not (folder / FILE).is_file():
        return []
    try:
        begun, told = _read(folder / FILE)
    except (CellError, KeyError):
        return []
    found: list[Activity] = []
    last = max((one.at for each in told.values() for one in each), default=begun)
    for device in LANES:
        states, commands, frames = (told.get(f"/{device}/{what}", []) for what in ("state", "command", "frame"))
        if device in CAMERAS:
            found += _looks(device, frames)
        elif device in ("laser", "claw"):
            found += _switched(device, commands, last)
        elif device == "rail":
            found += _rail_moves(states, commands, rate)
        else:
            found += _moves(device, states, _arm_moves if device == "arm" else _vehicle_moves)
    return [one._replace(begin=one.begin - begun, end=one.end - begun) for one in found]


def _read(record: Path) -> tuple[float, dict[str, list[_Told]]]:
    """When the first step began, s, and what was told from then on, by topic; nothing where none began."""
    told: dict[str, list[_Told]] = {}
    begun: float | None = None
    for topic, at, message in messages(record, ("/sequence/event", *(f"/{device}/" for device in LANES))):
        if not isinstance(message, dict):
            continue
        if begun is None and topic == "/sequence/event" and message.get("kind") == "step_started":
            begun = 1e-9 * at
        elif not message.get("refused"):
            told.setdefault(topic, []).append(_Told(1e-9 * at, message))
    return (0.0, {}) if begun is None else (begun, told)


def idle(busy: Iterable[Activity], length: float) -> list[tuple[float, float]]:
    """From when to when, s, no device moves, is lit or takes pictures, in a run of `length` s."""
    gaps, until = list[tuple[float, float]](), 0.0
    for activity in sorted(busy, key=lambda one: one.begin):
        if activity.begin > until:
            gaps.append((until, activity.begin))
        until = max(until, activity.end)
    return [*gaps, (until, length)] if length > until else gaps


def _moves(device: str, states: Sequence[_Told], moving: Callable[[State], bool]) -> list[Activity]:
    """Of a device whose states come all the time: from the last state at rest to the next one."""
    found: list[Activity] = []
    begun: _Told | None = None
    for before, now in pairwise(sorted(states, key=lambda told: told.at)):
        if moving(now.state):
            begun = begun or before
        elif begun is not None:
            found.append(Activity(device, begun.at, before.at, first=begun.state, last=before.state))
            begun = None
    if begun is not None:
        found.append(Activity(device, begun.at, now.at, first=begun.state, last=now.state))
    return found


def _number(state: State, name: str) -> float:
    value = state.get(name)
    return float(value) if isinstance(value, int | float) else 0.0


def _arm_moves(state: State) -> bool:
    speeds = state.get("joint_speeds")
    return isinstance(speeds, list) and bool(np.abs(np.array(speeds, dtype=np.float64)).max(initial=0.0) > MOVING)


def _vehicle_moves(state: State) -> bool:
    return max(abs(_number(state, name)) for name in ("speed", "yaw_rate")) > MOVING


def _rail_moves(states: Sequence[_Told], commands: Sequence[_Told], rate: float) -> list[Activity]:
    """From each command until its way is done, or something newer is told: at rest the rail is asked now and then."""
    sent = [one for one in commands if one.state.get("name") in ("home", "move_to", "sweep")]
    rests = [one.at for one in states if "homed" in one.state]
    found: list[Activity] = []
    stands = 0.0
    for k, command in enumerate(sent):
        given = command.state.get("arguments")
        given = given if isinstance(given, dict) else {}
        goal = _number(given, "stop" if "stop" in given else "position")
        # A look for the reference switch is told as a way to 0.
        way = abs(goal - stands) / (_number(given, "speed") or RAIL_M_S)
        longest = (way + (SHORTEST_S if goal else SWITCH_S)) / rate
        newer = [at for at in rests if at > command.at + SHORTEST_S][:1] + [one.at for one in sent[k + 1 : k + 2]]
        until = min(newer, default=command.at + longest)
        found.append(Activity("rail", command.at, until if "stop" in given else min(until, command.at + longest)))
        stands = goal
    return found


def _looks(device: str, frames: Sequence[_Told]) -> list[Activity]:
    found: list[Activity] = []
    for frame in frames:
        if found and frame.at - found[-1].end < APART_S:
            found[-1] = found[-1]._replace(end=frame.at, pictures=found[-1].pictures + 1)
        else:
            found.append(Activity(device, frame.at, frame.at + SHORTEST_S, pictures=1))
    return found


def _switched(device: str, commands: Sequence[_Told], last: float) -> list[Activity]:
    """The laser from each time it is lit until it is off, or until the record's `last` time; of a claw each command."""
    if device == "claw":
        return [Activity(device, command.at, command.at + SHORTEST_S) for command in commands]
    found: list[Activity] = []
    lit: float | None = None
    for command in commands:
        on = command.state.get("name") == "lit"
        if on and lit is None:
            lit = command.at
        elif not on and lit is not None:
            found.append(Activity(device, lit, command.at))
            lit = None
    return found if lit is None else [*found, Activity(device, lit, last)]
