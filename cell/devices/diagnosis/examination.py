"""A device's figures with their limits: round trips, whatever its driver tells of it, and a camera's stream."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from drivers.clock import Clock
from drivers.errors import InterlockError
from drivers.interfaces import Camera, Device, Examined, Frame, Reading

WATCHED_S = 1.0
LONGEST_TRIP_MS = {"arm": 100.0, "rail": 50.0, "vehicle": 100.0, "camera": 20.0, "laser": 100.0, "claw": 100.0}
"""By kind: what the cell has time for. A rail is asked for its position all along a sweep, a camera for its clock."""
LARGEST_TIME_BOUND_S = 0.001
"""0.02 mm of a sweep at 20 mm/s."""
MOST_UNEVEN = 1.5
"""Times the median: a frame that comes later than this is as good as lost."""
_LEAST_FRAMES = 3
_FRAMES_MISSED = (
    "Use a cable of its own, for GigE with packets of 9000 bytes; lower the frame rate or the region; end programs "
    "that keep this computer busy."
)


def examine(kind: str, device: Device, trips_s: Sequence[float], clock: Clock) -> list[Reading]:
    """Figures of a device of this kind whose round trips took `trips_s`, wall seconds. It is only looked at.

    On a clock that is not the wall's, times have no limits: a simulated cell in a hurry is no measure.
    """
    median, p99 = (1e3 * float(value) for value in np.percentile(trips_s, [50, 99]))
    judged = clock.rate <= 1.0
    found = [
        Reading("round trip, median", median, "ms"),
        Reading(
            "round trip, p99", p99, "ms", most=LONGEST_TRIP_MS[kind] if judged else None,
            remedy="Look at cable and adapter, and end programs that keep this computer busy.",
        ),
    ]  # fmt: skip
    if isinstance(device, Examined):
        found += device.examine(WATCHED_S)
    if kind == "camera":
        found += _camera_figures(cast(Camera, device), clock, judged)
    return found


def _camera_figures(camera: Camera, clock: Clock, judged: bool) -> list[Reading]:
    """Of a short stream at the rate that the camera has; none of one that has to be set before it gives pictures."""
    frames: list[Frame] = []
    try:
        with camera.stream() as stream:
            begun = clock.now()
            while len(frames) < _LEAST_FRAMES or clock.now() - begun < WATCHED_S:
                frames.append(stream.next(2.0))
            lost = stream.lost
    except InterlockError:
        return []
    return stream_figures([frame.device_time for frame in frames], lost, camera.time_bound, judged)


def stream_figures(device_times: Sequence[float], lost: int, time_bound: float, judged: bool) -> list[Reading]:
    """Figures of frames with these device times, s, of which `lost` more were missed."""
    gaps = np.diff(device_times)
    median = float(np.median(gaps))
    uneven = float(np.percentile(gaps, 99)) / median if median > 0 else np.nan
    return [
        Reading("frame rate by its clock", 1.0 / median if median > 0 else np.nan, "Hz"),
        Reading(
            "longest frame period over the median, p99", uneven, "", most=MOST_UNEVEN if judged else None,
            remedy=_FRAMES_MISSED,
        ),
        Reading("frames lost", float(lost), "", most=0.0 if judged else None, remedy=_FRAMES_MISSED),
        Reading(
            "clock known to", 1e3 * time_bound, "ms", most=1e3 * LARGEST_TIME_BOUND_S if judged else None,
            remedy="Use a cable of its own, and end programs that keep this computer busy.",
        ),
    ]  # fmt: skip
