"""The way from a device's clock to the host's, from latched device times and their round trips.

The device latched at some instant within the round trip, so half of it bounds the error of its middle. Of several
latches the shortest is kept; latches far apart show how fast the device's clock runs. A clock that was set meanwhile,
by a restart or by a time service, contradicts its earlier latches: they are forgotten.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

MAX_DRIFT = 100e-6
"""A crystal's drift that is expected before it has been measured."""
_KEEP = 64


@dataclass(frozen=True)
class Latch:
    """The device read `device` s somewhere between the host times `before` and `after`, s."""

    before: float
    device: float
    after: float

    @property
    def host(self) -> float:
        """Middle of the round trip, s."""
        return 0.5 * (self.before + self.after)

    @property
    def bound(self) -> float:
        """Largest possible error of `host`, s."""
        return 0.5 * (self.after - self.before)


class ClockMap:
    """Maps device times to host times; empty until the first `add`."""

    def __init__(self) -> None:
        self._latches: deque[Latch] = deque(maxlen=_KEEP)
        self._best: Latch | None = None
        self._rate = 1.0
        self._drift = MAX_DRIFT

    def add(self, latches: Iterable[Latch]) -> None:
        """Take the latches of one moment, of which the shortest round trip counts."""
        newest = min(latches, key=lambda latch: latch.bound)
        if self._best is not None and not self._continues(newest):
            self._latches.clear()
            self._rate, self._drift = 1.0, MAX_DRIFT
        self._latches.append(newest)
        oldest = self._latches[0]
        span = newest.device - oldest.device
        if span > 0.0 and (uncertainty := (newest.bound + oldest.bound) / span) < MAX_DRIFT:
            self._rate = (newest.host - oldest.host) / span
            self._drift = uncertainty
        self._best = min(self._latches, key=lambda latch: latch.bound + self._drift * (newest.host - latch.host))
        self._newest = newest

    def _continues(self, latch: Latch) -> bool:
        """Whether the clock may have run on evenly from the earlier latches to this one."""
        return abs(self.host_time(latch.device) - latch.host) <= self.bound_at(latch.host) + latch.bound

    def host_time(self, device: float) -> float:
        """Host time in s at which the device's clock read `device` s."""
        if self._best is None:
            raise ValueError("the clocks have not been compared yet")
        return self._best.host + self._rate * (device - self._best.device)

    @property
    def uncertainty(self) -> float:
        """Bound in s on the error of `host_time` near the newest latch."""
        return self.bound_at(self._newest.host)

    def bound_at(self, host: float) -> float:
        """Bound in s on the error of `host_time` near the host time `host`, s."""
        if self._best is None:
            raise ValueError("the clocks have not been compared yet")
        return self._best.bound + self._drift * abs(host - self._best.host)

    @property
    def drift(self) -> float:
        """Host seconds per device second, less one."""
        return self._rate - 1.0
