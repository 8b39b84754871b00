"""What has to hold before a command is passed on: checked in the gate, for real and simulated devices alike.

The rules themselves are a table in `cell.devices.gate.rules`. A person lifts named ones with `Cell.maintenance`;
nothing else does.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any

import pinocchio as pin

from cell.motion.collision import Body
from drivers.clock import Clock
from drivers.errors import ConfigError, InterlockError
from drivers.interfaces import Arm, ArmMotion, Claw, Laser, TriesOutputs, Vector, Vehicle

PURPOSES = ("sweep", "calibration", "test")


@dataclass(frozen=True, eq=False)
class DeviceCommand:
    """A command to a device before it is passed on: `arm.move_joints` with its arguments by name."""

    device: str
    name: str
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.device}.{self.name}"


@dataclass(eq=False)
class Situation:
    """What the rules look at: the bare devices, None where one is not connected, and what the cell knows of itself.

    `outputs` says by number which of the arm's outputs belong to another device. `clear(joints, command, others)` gives
    the pairs of bodies that the arm would bring together on the way that a command asks for, from where it stands (6,)
    in rad, with these others about; `part` is what the claw holds and `station` what stands before the vehicle, as far
    as a run has told. `postures` are joint angles (6,) and `looks` base_from_flange in which the vehicle may drive, by
    name. `configuration` is the hash of this cell as configured, `calibrated` that of the calibration in use. `last` is
    the newest motion of the arm, None when it is not known how that went, and `way` the joint angles (n, 6) that it
    follows, None for another kind of motion; `purposes` what this thread lights the laser for.
    `slowed(start, goal, speed, carried)` is the speed of a joint move that the tool speed allows. `clock` is the one
    that the devices share.
    """

    arm: Arm | None
    vehicle: Vehicle | None
    laser: Laser | None
    claw: Claw | None
    outputs: Mapping[int, str]
    clear: Callable[[Vector, DeviceCommand, Sequence[Body]], Sequence[tuple[str, str]]]
    forward: Callable[[Vector], pin.SE3]
    postures: Mapping[str, Vector]
    configuration: str
    looks: dict[str, pin.SE3] = field(default_factory=dict)
    calibrated: str | None = None
    last: ArmMotion | None = None
    way: Vector | None = None
    part: tuple[Body, ...] = ()
    station: tuple[Body, ...] = ()
    purposes: threading.local = field(default_factory=threading.local)
    slowed: Callable[[Vector, Vector, float, Sequence[Body]], float] = lambda start, goal, speed, carried: speed
    clock: Clock = field(default_factory=Clock)

    @property
    def held(self) -> tuple[Body, ...]:
        """What the claw holds, as far as a run has told; nothing when its switch shows no part."""
        empty = bool(self.part) and self.claw is not None and not self.claw.holding
        return () if empty else self.part

    @property
    def purpose(self) -> str | None:
        """What this thread lights the laser for, if it said so."""
        return getattr(self.purposes, "name", None)


@dataclass(frozen=True)
class Rule:
    """A rule: `check` gives None when the command may pass, else what stands against it, the value and the next step.

    `commands` are those that it is asked for. A rule without `check` is kept by the gate or by a device behind it; one
    that is not `liftable` holds in maintenance, too.
    """

    name: str
    commands: tuple[str, ...]
    condition: str
    check: Callable[[Situation, DeviceCommand], str | None] | None
    liftable: bool = True


class Interlocks:
    """The rules over one cell's situation. Commands are checked by any thread."""

    def __init__(self, situation: Situation, rules: Sequence[Rule]) -> None:
        self.situation = situation
        self._rules = tuple(rules)
        self._lifted: list[frozenset[str]] = []
        self._tried: list[int] = []

    def require(self, command: DeviceCommand) -> None:
        """Raise `InterlockError`, which names the rule, when one stands against the command; nothing was sent then."""
        lifted = self.names_lifted
        for rule in self._rules:
            if rule.check is None or str(command) not in rule.commands or rule.name in lifted:
                continue
            if (against := rule.check(self.situation, command)) is not None:
                raise InterlockError(command.device, f"{against} (interlock {rule.name}; {command} was not sent)")

    @property
    def names_lifted(self) -> frozenset[str]:
        """The rules that do not hold now."""
        return frozenset[str]().union(*self._lifted)

    @contextmanager
    def lifted(self, names: Sequence[str]) -> Iterator[None]:
        """Inside this context these rules do not hold, for any thread; `ConfigError` for one that cannot be lifted."""
        liftable = [rule.name for rule in self._rules if rule.check is not None and rule.liftable]
        if unknown := [name for name in names if name not in liftable]:
            raise ConfigError(f"{', '.join(unknown)}: no interlock that can be lifted; those are {', '.join(liftable)}")
        entry = frozenset(names)
        self._lifted.append(entry)
        try:
            yield
        finally:
            self._lifted.remove(entry)

    @contextmanager
    def tried(self, output: int) -> Iterator[None]:
        """Inside this context nobody knows what hangs on this output of the arm: it counts as a laser's. An arm that
        can is told so as well: should this process be killed, the output still goes off."""
        arm = self.situation.arm
        self._tried.append(output)
        try:
            with arm.trying(output) if isinstance(arm, TriesOutputs) else nullcontext():
                yield
        finally:
            self._tried.remove(output)

    def may_be_laser(self, output: int) -> bool:
        """Whether this output of the arm is switched off at any time, because a laser hangs on it or might."""
        return self.situation.outputs.get(output) == "laser" or output in self._tried

    @property
    def tried_outputs(self) -> tuple[int, ...]:
        """The arm's outputs of which nobody knows now what hangs on them."""
        return tuple(self._tried)

    @contextmanager
    def purpose(self, name: str) -> Iterator[None]:
        """Inside this context this thread may light the laser, for one of `PURPOSES`; `ConfigError` for another."""
        if name not in PURPOSES:
            raise ConfigError(f'"{name}" is nothing that the laser is lit for: {", ".join(PURPOSES)}')
        purposes = self.situation.purposes
        outer = getattr(purposes, "name", None)
        purposes.name = name
        try:
            yield
        finally:
            purposes.name = outer

    def may_drive_with(self, name: str, base_from_flange: pin.SE3) -> None:
        """The vehicle may also drive with the flange there: a looking pose that a job names."""
        self.situation.looks[name] = base_from_flange

    def carry(self, part: Sequence[Body]) -> None:
        """From now on this is in the claw, as long as the claw holds it: its bodies, in the flange frame."""
        self.situation.part = tuple(part)

    def stand_before(self, station: Sequence[Body]) -> None:
        """From now on these bodies stand about, in the arm base: until the vehicle is enabled, and may drive away."""
        self.situation.station = tuple(station)

    def work_with(self, configuration: str) -> None:
        """From now on work is done with a calibration that was made under the configuration of this hash."""
        self.situation.calibrated = configuration
