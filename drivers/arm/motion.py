"""A motion of the arm as its caller holds it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

from drivers.arm.faults import fault
from drivers.arm.messages import Pace
from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError, DeviceError

_WALL_MARGIN_S = 0.5


class UrMotion:
    """A motion that was started; `contact` tells whether it ended at its force limit.

    `pace` tells how regularly the points of a trajectory went out, once it has ended; None of other motions.
    """

    def __init__(self, device: str, what: str, number: int, clock: Clock, stop: Callable[[], None]) -> None:
        self.contact = False
        self.pace: Pace | None = None
        self.number = number
        self._device = device
        self._what = what
        self._clock = clock
        self._stop = stop
        self._ended = threading.Event()
        self._error: Exception | None = None

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""
        return self._ended.is_set()

    def wait(self, timeout: float) -> None:
        """Block until the arm stands at the motion's end, at most `timeout` s of the clock.

        With a clock that runs faster than the wall the wire's own time is allowed on top. Raises `DeadlineError` (the
        arm is then stopped), `DeviceFault`, or `Aborted` when a stop ended the motion.
        """
        margin = _WALL_MARGIN_S * max(0.0, self._clock.rate - 1.0)
        if not self._clock.wait(self._ended, timeout + margin):
            with suppress(DeviceError):
                self._stop()
            raise DeadlineError(
                self._device,
                f"{self._what} did not end within {timeout:g} s and was stopped. Allow more time or move faster.",
            )
        if self._error is not None:
            raise self._error

    def end(self, how: str, text: str = "") -> None:
        """Note how the motion ended: arrived, contact, stopped or a fault's code."""
        if how == "stopped":
            self.fail(Aborted(f"{self._device}: {self._what} was stopped before its end"))
        elif how in ("arrived", "contact"):
            self.contact = how == "contact"
            self._ended.set()
        else:
            self.fail(fault(self._device, how, text))

    def fail(self, error: Exception) -> None:
        """Note that the motion ended with an error; the first one counts."""
        if not self._ended.is_set():
            self._error = error
            self._ended.set()
