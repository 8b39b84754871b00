"""What is switched by an output of the arm: the laser and the claw."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol, runtime_checkable

from drivers.interfaces.device import Device


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
