"""The scan head behind the gate: its laser and its camera.

The laser behind the gate, with a watchdog: it goes off by itself when whoever lit it falls asleep.

A camera beside the gate: it moves nothing, and nothing holds its commands back; who listens there is told them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from cell.devices.gate.gate import Gate, Gated
from cell.devices.gate.interlocks import DeviceCommand
from drivers.clock import Clock
from drivers.errors import InterlockError
from drivers.interfaces import Camera, Frame, FrameStream, Laser


class GatedCamera(Gated[Camera]):
    """A camera whose commands are told at the gate."""

    def __init__(self, bare: Camera, gate: Gate) -> None:
        super().__init__(bare, gate)
        self.shape = bare.shape

    @property
    def time_bound(self) -> float:
        """See `Camera.time_bound`."""
        return self.bare.time_bound

    def configure(self, exposure: float, frame_rate: float) -> None:
        """See `Camera.configure`."""
        self.gate.asked(DeviceCommand(self.name, "configure", {"exposure": exposure, "frame_rate": frame_rate}))
        self.bare.configure(exposure, frame_rate)

    def grab(self, timeout: float = 2.0) -> Frame:
        """See `Camera.grab`."""
        self.gate.asked(DeviceCommand(self.name, "grab"))
        return self.bare.grab(timeout)

    @contextmanager
    def stream(self) -> Iterator[FrameStream]:
        """See `Camera.stream`."""
        self.gate.asked(DeviceCommand(self.name, "stream"))
        try:
            with self.bare.stream() as frames:
                yield frames
        finally:
            self.gate.asked(DeviceCommand(self.name, "stream ended"))


UNATTENDED_S = 20.0
"""Seconds on the wall for which the laser stays on when nobody renews it: eyes do not run faster with a simulation."""
RETRY_S = 0.5
"""Seconds on the wall after which a laser that could not be switched off is switched off again."""

log = logging.getLogger(__name__)


class GatedLaser(Gated[Laser]):
    """The laser, lit through a gate and for as long as its owner renews it."""

    def __init__(self, bare: Laser, gate: Gate, clock: Clock) -> None:
        super().__init__(bare, gate)
        self._clock = clock
        self._renewed = 0.0
        self._slept = self._off = False

    @contextmanager
    def lit(self) -> Iterator[None]:
        """See `Laser.lit`. Goes off, and raises `InterlockError` at the end, when it is not renewed every 20 s."""
        with ExitStack() as held:
            held.callback(lambda: self.gate.asked(DeviceCommand("laser", "off")))
            self.gate.begin(DeviceCommand("laser", "lit"), lambda: held.enter_context(self.bare.lit()), held.close)
            self._renewed, self._slept, self._off = self._clock.now(), False, False
            with self._clock.alarm(self._limit, self._look):
                yield
                self.renew()

    def renew(self) -> None:
        """Its owner is awake. `InterlockError` when it had fallen asleep and the laser went off meanwhile."""
        if self._slept:
            became = "went off" if self._off else "was to go off, which is not confirmed,"
            raise InterlockError(
                self.name,
                f"{became} because nobody renewed it for {UNATTENDED_S:.0f} s (interlock laser_attended). Light it "
                "only while it is needed, and call renew() on it meanwhile",
            )
        self._renewed = self._clock.now()

    @property
    def is_on(self) -> bool:
        """See `Laser.is_on`."""
        on = self.bare.is_on
        self.gate.seen("laser", {"on": on})
        return on

    @property
    def _limit(self) -> float:
        return UNATTENDED_S * self._clock.rate

    def _look(self) -> float | None:
        """Called by the alarm: off when the owner sleeps, else in how many seconds to look again.

        One that cannot be switched off is switched off again and again, until its owner's context ends.
        """
        left = self._renewed + self._limit - self._clock.now()
        if left > 0:
            return left
        self._slept = True
        try:
            self.bare.stop()
        # Whatever went wrong, the next attempt may do it.
        except Exception as error:
            log.error("the laser's owner sleeps, and it could not be switched off: %s", error)
            return RETRY_S * self._clock.rate
        self._off = True
        return None
