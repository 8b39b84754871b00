"""An arm: its state, its motions, its outputs."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import Enum
from typing import Protocol, runtime_checkable

from drivers.clock import Latch
from drivers.interfaces.device import Device, Motion, Vector
from drivers.link_table import LinkTable


class ArmSafety(Enum):
    """What the arm's safety system allows."""

    NORMAL = "normal"
    PROTECTIVE_STOP = "protective stop"
    SAFEGUARD_STOP = "safeguard stop"
    EMERGENCY_STOP = "emergency stop"
    FAULT = "fault"


@dataclass(frozen=True, eq=False)
class ArmState:
    """One state packet.

    `flange` is base_from_flange as (x, y, z, rx, ry, rz), m and rotation vector in rad, as the arm reports it from its
    joint encoders; `wrench` is force and torque at the flange in base axes, N and N·m. `stamp` is the host time at
    which the packet arrived, `device_time` in s the arm's own clock when it was measured. `controlled` is False while
    nothing can move the arm, because it has no power or no control program; its flange may then be that of any tool.
    `reason` says in words why it stopped for safety, as far as that is known.
    """

    stamp: float
    joints: Vector
    joint_speeds: Vector
    flange: Vector
    wrench: Vector
    safety: ArmSafety
    moving: bool
    digital_inputs: int
    digital_outputs: int
    device_time: float = 0.0
    controlled: bool = True
    reason: str = ""


class ArmMotion(Motion, Protocol):
    """A motion of the arm; `contact` tells whether a guarded motion ended because the force limit was met."""

    @property
    def contact(self) -> bool:
        """Whether it ended at its force limit."""


class Arm(Device, Protocol):
    """A six-axis arm with zero TCP: all Cartesian poses are of the flange in the base."""

    def link_table(self) -> LinkTable | None:
        """The table that its controller computes with, calibrated in the factory; None where it does not tell."""

    def state(self, max_age: float = 0.1) -> ArmState:
        """The newest state, at most `max_age` seconds old, else `DeadlineError`."""

    def record(self) -> AbstractContextManager[list[ArmState]]:
        """Every state that arrives while the context is open, in order, in a list that grows."""

    def latch_clock(self) -> Latch:
        """The arm's clock, as `device_time` of its states tells it, between two host times; takes a tenth of a second.

        That a state was measured when its time says so has to be taken on trust: how long the arm itself held it back
        before it was stamped cannot be known from outside.
        """

    def move_joints(self, joints: Vector, speed: float, acceleration: float) -> ArmMotion:
        """Straight in joint space to `joints` (rad) at `speed` rad/s of the leading joint."""

    def move_linear(self, flange: Vector, speed: float, acceleration: float) -> ArmMotion:
        """Straight in space to the flange pose (x, y, z, rx, ry, rz) at `speed` m/s."""

    def follow(self, times: Vector, joints: Vector, force_limit: float | None = None) -> ArmMotion:
        """Stream a joint trajectory: `times` (n,) s from 0, `joints` (n, 6) rad, on absolute deadlines.

        The first point must be where the arm stands (0.02 rad), else `InterlockError`. With `force_limit` (N) the
        motion ends, held at rest and without error, as soon as the force has changed by that much since its start.
        """

    def zero_force(self) -> None:
        """Take the present wrench as zero."""

    def set_payload(self, mass: float, centre: Vector) -> None:
        """Mass in kg and centre of gravity (3,) in the flange frame, m."""

    def set_digital_output(self, index: int, value: bool) -> None:
        """Set a digital output (0-7 standard, 8-15 configurable, 16-17 tool) and return once the arm shows it."""

    def digital_input(self, index: int) -> bool:
        """Read a digital input from the newest state."""

    def recover(self, *, confirmed: bool = False) -> None:
        """Restart the link if needed and upload the control program again, with the laser's output off.

        A protective stop is cleared only when a person has `confirmed` it, else `DeviceFault` (arm.protective_stop).
        `stop()` and `close()` end it: it raises `Aborted`, and nothing was unlocked or started after them.
        """


@runtime_checkable
class TriesOutputs(Protocol):
    """What an arm may offer besides `Arm` when the laser hangs on its outputs and may hang on another than is told."""

    def trying(self, index: int) -> AbstractContextManager[None]:
        """Inside the context this output goes off as the laser's does when link, driver or this process are lost."""


@runtime_checkable
class SaysWhyUntold(Protocol):
    """What an arm may offer besides `Arm`: a reason beside a link table that it did not tell."""

    @property
    def untold(self) -> str:
        """Why `Arm.link_table` is None, in words; "" where it is not, or where the arm never tells one."""


def why_untold(arm: Arm) -> str:
    """Why the arm has told no link table, or "" when it has, or gives no reason."""
    return arm.untold if isinstance(arm, SaysWhyUntold) else ""
