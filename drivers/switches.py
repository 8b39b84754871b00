"""Laser and claw on digital outputs of the arm.

The arm keeps an output when a program ends, so the laser's interlock has three parts: one owner at a time, off when
its context is left for whatever reason, and off again on `stop()` and `close()`.
"""

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from drivers.clock import Clock, timeout_of
from drivers.errors import DeviceFault, InterlockError, in_the_end
from drivers.interfaces import Identity, LinkStatistics

_POLL_S = 0.01


class Shown(Protocol):
    """What a connector shows, as far as a switch looks at it."""

    @property
    def digital_outputs(self) -> int:
        """The outputs as bits."""


class Connector(Protocol):
    """Outputs and inputs to hang something on: an arm, or what stands in for it."""

    def identity(self) -> Identity:
        """Whose they are."""

    def ping(self) -> float:
        """One round trip, wall seconds."""

    def state(self) -> Shown:
        """What it shows now."""

    def set_digital_output(self, index: int, value: bool) -> None:
        """Set an output and return once it is so."""

    def digital_input(self, index: int) -> bool:
        """Read an input."""


class _Switch:
    """What both share: a named output of an arm, with the arm as the wire."""

    def __init__(self, name: str, arm: Connector, output: int) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self._arm = arm
        self._output = output

    def identity(self) -> Identity:
        arm = self._arm.identity()
        return Identity(f"switch on {arm.model}", arm.serial, arm.firmware, f"{arm.address} output {self._output}")

    def ping(self) -> float:
        """One round trip to the arm that carries the switch, in wall seconds."""
        seconds = self._arm.ping()
        self.statistics.add_round_trip(seconds)
        return seconds

    def _shows(self) -> bool:
        return bool(self._arm.state().digital_outputs >> self._output & 1)


class ArmSwitchedLaser(_Switch):
    """A line laser on the digital output `output` of `arm`."""

    def __init__(self, name: str, arm: Connector, output: int) -> None:
        super().__init__(name, arm, output)
        self._owner = threading.Lock()

    @contextmanager
    def lit(self) -> Iterator[None]:
        """On inside the context, off after it, whatever happens inside. Raises `InterlockError`, with nothing switched,
        when the laser is lit already: by another context of this program or by anything else that set the output."""
        if not self._owner.acquire(blocking=False):
            raise InterlockError(self.name, "is already lit by another owner. Wait until that one has finished")
        try:
            if self._shows():
                raise InterlockError(
                    self.name, f"output {self._output} is already on and not ours. Switch it off with stop() first"
                )
            with in_the_end(lambda: self._arm.set_digital_output(self._output, False)):
                self._arm.set_digital_output(self._output, True)
                yield
        finally:
            self._owner.release()

    @property
    def is_on(self) -> bool:
        """What the arm's newest state shows for the output, not what was commanded."""
        return self._shows()

    def stop(self) -> None:
        """Laser off now, whoever has it."""
        self._arm.set_digital_output(self._output, False)

    def close(self) -> None:
        """Laser off; the arm stays connected."""
        self.stop()


class ConfirmedClaw(ABC):
    """What claws share that one switch closes and another one confirms; `_shown_by` names the one that confirms."""

    name: str
    _clock: Clock
    _shown_by: str

    @abstractmethod
    def _close(self, closed: bool) -> None:
        """Set the switch."""

    @property
    @abstractmethod
    def holding(self) -> bool:
        """What the feedback input shows."""

    def grip(self, timeout: float = 2.0) -> None:
        """Close and wait for the feedback; `DeviceFault` (claw.no_part) when no part is held after `timeout` s."""
        self._close(True)
        if not self._feedback_becomes(True, timeout):
            raise DeviceFault(
                self.name,
                "claw.no_part",
                f"closed, but after {timeout:.3g} s {self._shown_by} does not show a held part",
                recoverable=True,
                hint="See that the part lies between the fingers and that the feedback is wired, then grip again.",
            )

    def release(self, timeout: float = 2.0) -> None:
        """Open and wait for the feedback; `DeviceFault` (claw.stuck) when a part is still held after `timeout` s."""
        self._close(False)
        if not self._feedback_becomes(False, timeout):
            raise DeviceFault(
                self.name,
                "claw.stuck",
                f"opened, but after {timeout:.3g} s {self._shown_by} still shows a held part",
                recoverable=True,
                hint="See whether the part sticks to the fingers; the arm must not retreat before it is free.",
            )

    def _feedback_becomes(self, value: bool, timeout: float) -> bool:
        deadline = self._clock.now() + timeout_of(self._clock, timeout)
        while self.holding != value:
            if self._clock.now() >= deadline:
                return False
            self._clock.sleep(_POLL_S)
        return True


class ArmSwitchedClaw(_Switch, ConfirmedClaw):
    """A gripper on the digital output `output` of `arm` (on = closed), confirmed by the digital input `feedback`."""

    def __init__(self, name: str, arm: Connector, output: int, feedback: int, *, clock: Clock | None = None) -> None:
        super().__init__(name, arm, output)
        self._feedback = feedback
        self._shown_by = f"input {feedback}"
        self._clock = clock or Clock()

    @property
    def holding(self) -> bool:
        """What the feedback input shows."""
        return self._arm.digital_input(self._feedback)

    def stop(self) -> None:
        """Nothing to stop: the claw stays as it is, because opening would drop the part."""

    def close(self) -> None:
        """Leave the claw as it is; the arm stays connected."""

    def _close(self, closed: bool) -> None:
        self._arm.set_digital_output(self._output, closed)
