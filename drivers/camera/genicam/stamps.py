"""What a camera's time stamps are worth: its clock against the host's, and each triggered picture against its trigger.

A camera whose clock can be latched is asked before each acquisition. Of one without a latch a triggered picture tells:
its exposure began after the trigger was sent, and ended before the picture came.
"""

from __future__ import annotations

import math
from dataclasses import replace

from drivers.camera.genicam.device import GenicamDevice
from drivers.clock import Clock
from drivers.clock_map import ClockMap, Latch
from drivers.errors import DeviceFault
from drivers.interfaces import Frame

_LATCHES, _MAX_LATCHES = 8, 32
_GOOD_LATCH_WALL_S = 0.0005
_SLACK_S = 0.002
"""By how much a time stamp may leave the interval of its trigger beyond what the clocks are known to."""


class StampClock:
    """The stamps of the camera `name` since it was connected."""

    def __init__(self, name: str, clock: Clock) -> None:
        self._name = name
        self._clock = clock
        self._map: ClockMap | None = None
        self._latched = False

    @property
    def bound(self) -> float:
        """Largest error in s of a host time; unlimited while nothing has told of the camera's clock."""
        return math.inf if self._map is None else self._map.uncertainty

    @property
    def slack(self) -> float:
        """By how much, in s, a stamp may seem too early or too late."""
        return _SLACK_S + (0.0 if self._map is None else self._map.uncertainty)

    def compare(self, device: GenicamDevice) -> None:
        """Latch the camera's clock, as often as it takes to get a short round trip; nothing if it has no latch."""
        latches: list[Latch] = []
        good = _GOOD_LATCH_WALL_S * self._clock.rate
        while len(latches) < _LATCHES or (
            len(latches) < _MAX_LATCHES and min(latch.after - latch.before for latch in latches) > good
        ):
            latch = device.latch(self._clock)
            if latch is None:
                return
            latches.append(latch)
        self._latched = True
        self._add(latches)

    def host_time(self, device_time: float, *, latest: float) -> float:
        """Host time in s of a stamp; `latest`, at which it was at the latest, while the clock is not known."""
        return latest if self._map is None else self._map.host_time(device_time)

    def judged(self, frame: Frame, called: float) -> Frame:
        """The frame of a trigger that was sent at `called`, s; `DeviceFault` (camera.clock) when its stamp is none."""
        last = frame.received - frame.exposure
        early = called - frame.host_time
        if self._map is not None and early > self.slack:
            raise self._wrong("before it was triggered", early, self.slack)
        if (wrong := self.impossible(frame)) is not None:
            raise wrong
        if self._latched or not frame.device_time or last <= called:
            return frame
        self._add([Latch(called, frame.device_time, last)])
        return replace(frame, host_time=self.host_time(frame.device_time, latest=last))

    def impossible(self, frame: Frame) -> DeviceFault | None:
        """The fault (camera.clock) of a picture that was here before its exposure can have ended, as its stamp says."""
        if self._map is None:
            return None
        slack = _SLACK_S + self._map.bound_at(frame.received)
        late = frame.host_time - (frame.received - frame.exposure)
        return None if late <= slack else self._wrong("too late to be here already", late, slack)

    def _add(self, latches: list[Latch]) -> None:
        if self._map is None:
            self._map = ClockMap()
        self._map.add(latches)

    def _wrong(self, which: str, off: float, allowed: float) -> DeviceFault:
        return DeviceFault(
            self._name,
            "camera.clock",
            f"the time stamp of a picture says that its exposure began {1e3 * off:.1f} ms {which} "
            f"(allowed: {1e3 * allowed:.1f} ms)",
            recoverable=False,
            hint="Its stamps are none of the start of the exposure, or its clock was set meanwhile or does not run at "
            "the rate that it tells. Look into its maker's manual; such a camera cannot measure a sweep.",
        )
