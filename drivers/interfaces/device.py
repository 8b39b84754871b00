"""What every device offers, whatever its kind: who it is, how well its link does, how a motion is waited for.

What is switched by an output of the arm: the laser and the claw."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.traffic import Traffic

Vector = NDArray[np.float64]
"""Array of shape (n,), float64."""

ATTENDED_S = 0.15
"""Wall seconds of silence after which a motion that somebody attends is stopped: nearly two beats of 80 ms. With what
braking a slow motion takes the device stands within 250 ms."""


@dataclass(frozen=True)
class Identity:
    """Who a device is: used by `cell diag` and to tie a calibration to its hardware."""

    model: str
    serial: str
    firmware: str
    address: str


@dataclass
class LinkStatistics:
    """Health of a link since it was opened: round trips in seconds (newest 1000) and error counters by name; and its
    `traffic`, for whoever listens."""

    round_trips_s: list[float] = field(default_factory=list)
    errors: dict[str, int] = field(default_factory=dict)
    traffic: Traffic = field(default_factory=Traffic, repr=False, compare=False)

    def add_round_trip(self, seconds: float) -> None:
        """Record one round trip, forgetting the oldest beyond 1000."""
        self.round_trips_s.append(seconds)
        if len(self.round_trips_s) > 1000:
            del self.round_trips_s[:500]

    def count(self, name: str) -> None:
        """Add one to the error counter `name`."""
        self.errors[name] = self.errors.get(name, 0) + 1


@dataclass(frozen=True)
class Reading:
    """One figure of a device's health: `value` in `unit`, good from `least` to `most`; None where there is no limit.

    `remedy` is what a person does when it is outside. A value that is not a number is outside of any limit.
    """

    what: str
    value: float
    unit: str
    least: float | None = None
    most: float | None = None
    remedy: str = ""

    @property
    def ok(self) -> bool:
        """Whether the value is inside its limits."""
        above = self.least is None or self.value >= self.least
        return above and (self.most is None or self.value <= self.most)


@runtime_checkable
class Examined(Protocol):
    """What a device may offer besides `Device`: figures of its health."""

    def examine(self, seconds: float) -> list[Reading]:
        """Watch the device for `seconds` of the clock: nothing on it is set, started or ended. Errors as of `ping`."""


class Device(Protocol):
    """What every device offers. `name` is its name in the configuration and in every error."""

    name: str
    statistics: LinkStatistics

    def identity(self) -> Identity:
        """Ask the device who it is."""

    def ping(self) -> float:
        """One harmless round trip on the wire, in wall seconds; also recorded in `statistics`."""

    def stop(self) -> None:
        """Bring the device to rest (or its output off) now, overtaking everything."""

    def close(self) -> None:
        """Stop, then release the connection."""


class Motion(Protocol):
    """A motion that was started."""

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""

    def wait(self, timeout: float) -> None:
        """Block until the motion has reached its end.

        Raises `DeadlineError` after `timeout` seconds (the device is then stopped), `DeviceFault` when the device
        failed, `Aborted` when `stop()` ended the motion early. Never returns for a motion that did not arrive.
        """


@runtime_checkable
class Attended(Protocol):
    """What a device may offer besides: motions that go on only as long as somebody says so again and again."""

    def attended(self) -> AbstractContextManager[Callable[[], None]]:
        """While it is open, what moves is stopped once the function that it gives was not called for `ATTENDED_S`.

        A process beside this one sees to that, also when this one hangs, is frozen or was killed. `InterlockError` when
        there is none; the function raises it, or a `DeviceFault`, when it is lost.
        """


class Laser(Device, Protocol):
    """A line laser on a switch with an interlock: lit only while its owner holds it."""

    def lit(self) -> AbstractContextManager[None]:
        """On inside the context, off after it, whatever happens inside."""

    @property
    def is_on(self) -> bool:
        """What the output shows, not what was commanded."""


@runtime_checkable
class SaysHowKnown(Protocol):
    """What a laser may offer besides `Laser` when nobody can ask its switch."""

    @property
    def how_known(self) -> str:
        """Why `is_on` is not what the output shows, in words for people; "" where it is."""


class Claw(Device, Protocol):
    """A gripper on a switch with a feedback input."""

    def grip(self, timeout: float = 2.0) -> None:
        """Close; `DeviceFault` when the feedback does not confirm a held part in time."""

    def release(self, timeout: float = 2.0) -> None:
        """Open; `DeviceFault` when the feedback still shows a held part."""

    @property
    def holding(self) -> bool:
        """What the feedback shows."""
