"""Did the camera's clock step in the middle of a sweep, as one does that is set anew over the network?

Then the pictures before and after it are paired with places that do not go together. A step shows twice: the stamps
leave their even pace by the pictures' numbers, and the pictures seem to arrive by as much sooner or later. A camera
that paces unevenly shows only the first, a network or a machine that is busy only the second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from drivers.errors import DeviceFault
from drivers.interfaces import Vector

WINDOW = 7
"""Pictures before and after a moment that are compared."""


def step_of_clock(numbers: Sequence[int], stamps: Sequence[float], received: Sequence[float]) -> float:
    """The largest step, s, of the clock that the `stamps` of pictures with these `numbers` come from; 0 for few."""
    number, stamp = np.array(numbers, dtype=np.float64), np.array(stamps)
    window = min(WINDOW, len(number) // 4)
    if window < 3:
        return 0.0
    off_pace = stamp - np.polyval(np.polyfit(number, stamp, 1), number)
    # Whatever holds a picture up makes it later, never sooner: of its ways the fastest tells.
    by_pace, sooner = _steps(off_pace, window, np.median), -_steps(np.array(received) - stamp, window, np.min)
    both = np.where(by_pace * sooner > 0.0, np.minimum(np.abs(by_pace), np.abs(sooner)), 0.0)
    k = int(np.argmax(both))
    return float(np.copysign(both[k], by_pace[k]))


def require_one_clock(
    camera: str,
    numbers: Sequence[int],
    stamps: Sequence[float],
    received: Sequence[float],
    speed: float,
    most: float,
) -> None:
    """Raise `DeviceFault` (camera.clock_stepped) where a step parts the lines of a sweep at `speed`, m/s, by over
    `most`, m."""
    step = step_of_clock(numbers, stamps, received)
    if speed * abs(step) <= most:
        return
    raise DeviceFault(
        camera,
        "camera.clock_stepped",
        f"its clock stepped by about {1e3 * step:+.1f} ms during the sweep: the pictures before and after it lie "
        f"{1e3 * speed * abs(step):.3f} mm apart along the sweep, allowed are {1e3 * most:.3f} mm",
        recoverable=True,
        hint="See whether a network clock (PTP) or another application sets the camera's clock.",
    )


def _steps(values: Vector, window: int, of: Callable[..., Vector]) -> Vector:
    """What is told `of` the `window` values from each place on, less that of those before it."""
    told = of(np.lib.stride_tricks.sliding_window_view(values, window), axis=1)
    return np.asarray(told[window:] - told[:-window])
