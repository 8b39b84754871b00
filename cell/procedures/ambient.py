"""Ambient light: how long the cameras may expose under it, and whether the laser's line stands out of it.

In a room a picture at the exposure that is asked for shows next to none, and nothing is done here. Where a picture is
whitened by it, the camera exposes no longer than `GatedCamera.longest_exposure` until the next job or calibration
begins; before each sweep the scan camera then takes a picture without the laser, which says how long it may expose.
"""

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from cell.devices.devices import Devices
from cell.devices.gate.gated import GatedCamera
from cell.measure.vision.pictures import counts_of, percentile
from drivers.errors import DeviceFault, LimitError, Measured, RefusedError
from drivers.interfaces import Frame
from drivers.interfaces import Vector as Array

Taken = TypeVar("Taken")

MOST_DN, WANTED_DN = 140.0, 100.0
"""Grey level below which 95 % of a picture may lie, and to which the exposure brings it beyond: the line has the rest
of the range, and so has light that grows by half."""
WHITE_DN, WHITER = 250, 4.0
"""A picture that is white tells only that it is to be shorter: by so many times."""
WHITE_SHARE = 0.01
TRIES = 8
REACHES = "ambient light reaches"
"""So the note of a sweep in bright light begins."""
STEP_S = 1e-5
"""Cameras take whole steps of some microseconds."""
LEAST_LINES = 0.3
"""Share of a picture's rows in which the line stands out, in half of a sweep's pictures."""
MOST_WHITE = 0.05
"""Share of a sweep's pictures that may be white: where a shadow has moved away, it is swept again."""


def bearable(frame: Frame) -> float:
    """How long, s, a camera may expose under the light that this picture shows; no longer than it did."""
    level = percentile(counts_of(frame.image), 95)
    if level <= MOST_DN:
        return frame.exposure
    return frame.exposure * (WANTED_DN / level if level < WHITE_DN else 1.0 / WHITER)


def shorten(camera: GatedCamera, exposure: float) -> None:
    """Let the camera expose no longer than `exposure`, s. Raises `RefusedError` where it cannot expose so briefly."""
    try:
        camera.shorten(max(STEP_S, math.floor(exposure / STEP_S) * STEP_S))
    except (LimitError, DeviceFault) as error:
        camera.longest_exposure = math.inf
        raise RefusedError(
            f"ambient light whitens the pictures of {camera.name}, and it takes none as short as {1e3 * exposure:.3f} "
            f"ms ({error}). Shade the place, or put a grey or a band-pass filter before the lens"
        ) from error


def in_any_light(camera: GatedCamera, take: Callable[[], Taken]) -> Taken:
    """What `take` photographs; again with shorter exposures where it refuses a picture that is partly white. Raises
    what `take` raises, and `RefusedError` where the camera cannot expose so briefly."""
    for _ in range(TRIES):
        try:
            return take()
        except RefusedError as refused:
            frame = refused.seen.get("frame")
            if not isinstance(frame, Frame) or (frame.image >= WHITE_DN).mean() < WHITE_SHARE:
                raise
            shorten(camera, frame.exposure / WHITER)
    return take()


def meet_light(devices: Devices) -> tuple[str, ...]:
    """Before a sweep, with the scan camera ready where it begins: choose its exposure by a picture without the laser.

    For people, what was chosen; nothing is done unless a picture of this job was whitened. Raises `RefusedError` where
    the camera cannot expose so briefly.
    """
    if not devices.bright:
        return ()
    dark = adapted(devices.scan_camera, devices.scan_camera.grab())
    level = percentile(counts_of(dark.image), 95)
    return (f"{REACHES} {level:.0f} of 255 grey levels at the exposure of {1e3 * dark.exposure:.2f} ms",)


def adapted(camera: GatedCamera, frame: Frame) -> Frame:
    """The `frame` that the camera took, or one with an exposure that the light allows."""
    for _ in range(TRIES):
        if (exposure := bearable(frame)) >= frame.exposure:
            break
        shorten(camera, exposure)
        frame = camera.grab()
    return frame


def require_line(shares: Array, lit: Frame, heights: Array) -> None:
    """Raise `RefusedError` where ambient light hides the laser's line in a sweep: `shares` (n,) of the rows show it in
    its pictures, `heights` (m,) DN above what surrounds it in the middle one, `lit`."""
    share = float(np.median(shares))
    if share < LEAST_LINES:
        level, height = percentile(counts_of(lit.image), 95), float(np.median(heights)) if len(heights) else 0.0
        raise hidden(
            f"{REACHES} {level:.0f} of 255 grey levels at the exposure of {1e3 * lit.exposure:.2f} ms, and "
            f"the laser's line stands {height:.0f} above it in {100.0 * share:.0f} % of the rows", share
        ).showing(seen={"frame": lit})  # fmt: skip


def hidden(seen: str, share: float) -> RefusedError:
    """The refusal of a job whose line ambient light hides: what was `seen`, and the `share` of rows that show it."""
    return RefusedError(
        f"{seen}, at least {100.0 * LEAST_LINES:.0f} % are needed: it hides the line. Shade the place, put a narrower "
        "band-pass filter for the laser's wavelength before the lens (scan_camera.filter), or use a stronger laser; "
        "then run the job again",
        Measured("rows with the laser's line under ambient light", 100.0 * share, "%", least=100.0 * LEAST_LINES),
    )
