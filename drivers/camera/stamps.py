"""Whether a frame's times can be true: each on its own, and against the frame before it.

A stamp that is wrong by a frame puts a whole line of a sweep elsewhere, and nothing in the picture shows it.
"""

from __future__ import annotations

import math

from drivers.clock import Clock
from drivers.errors import DeviceFault
from drivers.interfaces import Frame

AHEAD_S = 0.020
"""So much later than the picture came its exposure may end by its stamp: late stamps and clocks that run apart."""
_SAME = 0.02
"""By how much, relative, an exposure may differ from its setting."""
_APART = 0.5
"""Share of the exposure before that two stamps are apart at least."""


class StampCheck:
    """Judges the frames of one acquisition of the camera `name`, in the order in which they come; all of them are
    exposed `exposure` s, where that is known."""

    def __init__(self, name: str, clock: Clock, exposure: float | None) -> None:
        self._name = name
        self._exposure = exposure
        self._ahead = AHEAD_S * max(1.0, clock.rate)
        self._last: Frame | None = None

    def fault(self, frame: Frame) -> DeviceFault | None:
        """The `DeviceFault` camera.exposure or camera.stamp that the frame shows, None for one that can be true.

        Frames with a number below the last one's are late ones, of which nothing is said.
        """
        last = self._last
        if last is not None and frame.frame_id <= last.frame_id:
            return None
        self._last = frame
        if not (math.isfinite(frame.exposure) and frame.exposure > 0.0):
            return self._made("camera.exposure", f"frame {frame.frame_id} says it was exposed {frame.exposure:g} s")
        wanted = frame.exposure if self._exposure is None else self._exposure
        if abs(frame.exposure - wanted) > _SAME * wanted:
            return self._made(
                "camera.exposure",
                f"frame {frame.frame_id} was exposed {1e3 * frame.exposure:.2f} ms instead of {1e3 * wanted:.2f} ms: "
                "it belongs to another setting",
            )
        if not (math.isfinite(frame.device_time) and math.isfinite(frame.host_time)):
            return self._made("camera.stamp", f"the time stamp of frame {frame.frame_id} is {frame.device_time:g} s")
        early = frame.host_time + frame.exposure - frame.received
        if early > self._ahead:
            return self._made(
                "camera.stamp",
                f"the time stamp of frame {frame.frame_id} lies in the future: its exposure ends {1e3 * early:.1f} ms "
                f"after the picture came (allowed {1e3 * self._ahead:.0f} ms)",
            )
        if last is None:
            return None
        step = frame.device_time - last.device_time
        if step <= 0.0:
            return self._made(
                "camera.stamp",
                f"the time stamp of frame {frame.frame_id} goes back by {-1e3 * step:.1f} ms from that of frame "
                f"{last.frame_id}",
            )
        if step < _APART * last.exposure:
            return self._made(
                "camera.stamp",
                f"the time stamp of frame {frame.frame_id} lies {1e3 * step:.2f} ms after that of frame "
                f"{last.frame_id}, within its exposure of {1e3 * last.exposure:.2f} ms: it belongs to another exposure",
            )
        return None

    def _made(self, code: str, what: str) -> DeviceFault:
        return DeviceFault(
            self._name,
            code,
            what,
            recoverable=False,
            hint="Restart the camera, and see whether something sets its clock meanwhile (time service, another "
            "program). If it comes back, the camera's firmware is at fault.",
        )
