"""One sweep over a strip of the surface: frames are turned into points while they come, and paired with poses after.

A frame is let go once its profile is triangulated, so memory does not grow with the sweep. A camera's clock may step in
the middle of a sweep. A step shows twice: the stamps leave their even pace, and the pictures seem to arrive by as much
sooner or later. A camera that paces unevenly shows only the first, a busy network only the second.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.config.job import ScanSection
from cell.measure.calibration.drift.timing import StampTiming
from cell.measure.geometry.poses import from_matrix
from cell.measure.inversion import NominalSurface
from cell.measure.reconstruction.build import ProfileBuilder, ScanGeometry
from cell.measure.vision.stripe.extract import StripeStream, around_stripe, drawn
from cell.measure.vision.stripe.profile import StripeProfile
from cell.procedures.ambient import WHITER, bearable
from cell.procedures.frame_store import Cut
from drivers.errors import DeviceFault
from drivers.interfaces import Camera, Frame, FrameStream, Sweep, Vector

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
    camera: str, numbers: Sequence[int], stamps: Sequence[float], received: Sequence[float], speed: float, most: float
) -> None:
    """Raise `DeviceFault` (camera.clock_stepped) where a step parts the lines of a sweep at `speed`, m/s, by over
    `most`, m."""
    step = step_of_clock(numbers, stamps, received)
    if speed * abs(step) <= most:
        return
    raise DeviceFault(
        camera, "camera.clock_stepped",
        f"its clock stepped by about {1e3 * step:+.1f} ms during the sweep: the pictures before and after it lie "
        f"{1e3 * speed * abs(step):.3f} mm apart along the sweep, allowed are {1e3 * most:.3f} mm", recoverable=True,
        hint="See whether a network clock (PTP) or another application sets the camera's clock.",
    )  # fmt: skip


def _steps(values: Vector, window: int, of: Callable[..., Vector]) -> Vector:
    """What is told `of` the `window` values from each place on, less that of those before it."""
    told = of(np.lib.stride_tricks.sliding_window_view(values, window), axis=1)
    return np.asarray(told[window:] - told[:-window])


FRAMES_LOST = "camera.frames_lost"
MAX_LOST_FRACTION = 0.05
STEP_SHARE = 0.5
"""Of what a sweep may lie off as a whole, by which its lines may lie apart."""


@dataclass(frozen=True)
class SweepErrors:
    """What a sweep's pose may be off by.

    `repeatability` (6, 6) of base_from_flange each time the arm comes to rest, m² and rad²; `rail` one standard
    deviation of a rail position, m; `shift` the farthest that a sweep may lie off by its times, m; `rate` seconds of
    the clock per wall second; `late` the most that a device may hold a reading back, s; `timing` how late the camera's
    stamps come, where that was measured; `lost` the share of its frames that may be lost.
    """

    repeatability: Vector
    rail: float
    shift: float
    rate: float = 1.0
    late: float = 0.0
    timing: StampTiming | None = None
    lost: float = MAX_LOST_FRACTION

    @property
    def by_rail(self) -> "SweepErrors":
        """For a sweep by the rail: `late` with the variance of what was measured."""
        return self if self.timing is None else replace(self, late=float(np.sqrt(3.0)) * self.timing.sigma)


@dataclass(frozen=True)
class TimeBound:
    """The times that the device `name`, a rail, arm or camera by its `kind`, tells may be off by `bound` s at most."""

    name: str
    kind: str
    bound: float

    @classmethod
    def of(cls, camera: Camera) -> "TimeBound":
        """Of a camera's frames."""
        return cls(camera.name, "camera", camera.time_bound)


def shift_by_times(known: Sequence[TimeBound], speed: float, errors: SweepErrors) -> tuple[float, float]:
    """How far (m) a sweep at `speed` m/s may lie off along its way because of its times, and the variance (m²) of it.

    Each time is anywhere within its bound, for all lines alike: uniform, so a third of the square. Raises `DeviceFault`
    (late_readings of the rail, the arm or the camera) of the worst device when it may be more than `errors.shift`.
    docs/explanation/theory.md, section 10.
    """
    shift = speed * sum(one.bound for one in known)
    if not shift <= errors.shift:
        worst = max(known, key=lambda one: one.bound)
        told = " and ".join(f"those of the {one.kind} to ±{1e3 * one.bound / errors.rate:.1f} ms" for one in known)
        raise DeviceFault(
            worst.name, f"{worst.kind}.late_readings",
            f"replies come so late that times are not known well enough, {told} at best: at {1e3 * speed:.2f} mm/s the "
            f"sweep may lie {1e3 * shift:.3f} mm off, allowed are {1e3 * errors.shift:.3f} mm", recoverable=True,
            hint=f"Shorten the way to the {worst.kind} (baud rate, adapter, network, load of this machine) or sweep "
            "more slowly.",
        )  # fmt: skip
    return shift, speed**2 * (sum(one.bound**2 for one in known) + errors.late**2) / 3.0


@dataclass(frozen=True, eq=False)
class Swath:
    """What one sweep brought.

    For each of its n lines: the profile's number in `builder`, the frame's id in `frame_ids`, the `times` (n,) in s at
    the middle of its exposure, base_from_flange in `flanges` (n, 4, 4), the `rail`'s position (n,), and `line_spread`
    (n, 3), m in base axes, one standard deviation of the line's own place. `seen` are the ids of all its frames, also
    of those that made no line. `covariance` (6, 6) of base_from_flange is common to all lines. `lost` counts frames
    lost or left out; `residual` in m is how far readings scatter about an even motion; `shift` in m see `SweepErrors`.
    """

    builder: ProfileBuilder
    lines: NDArray[np.intp]
    frame_ids: NDArray[np.intp]
    times: Vector
    flanges: Vector
    rail: Vector
    line_spread: Vector
    covariance: Vector
    lost: int
    residual: float
    points: int
    middle: Frame
    middle_profile: StripeProfile
    shift: float
    seen: NDArray[np.intp]

    @property
    def base_from_flange(self) -> pin.SE3:
        """Where the flange was half-way."""
        return from_matrix(self.flanges[len(self.flanges) // 2])


@dataclass(frozen=True, eq=False)
class RailPath:
    """What the rail told during a sweep: `samples` (n, 2), host time in s and position in m."""

    samples: Vector


_WARMED_UP: set[tuple[int, int]] = set()
"""Heights and widths of pictures for which that was done."""


def warm_up(geometry: ScanGeometry) -> None:
    """Take two drawn profiles and let them go: what is loaded or compiled on first use is so before anything moves.

    Done under way it takes longer than the gaps that frames and the arm's states may have. Once for pictures of a size:
    a process that has read some has everything loaded.
    """
    size = geometry.camera.height, geometry.camera.width
    if size in _WARMED_UP:
        return
    builder = ProfileBuilder(geometry, 2)
    for picture in drawn(*size):
        builder.see(StripeStream().extract(picture))
    _WARMED_UP.add(size)


def frames_of(sweep: Sweep, frames: FrameStream) -> Iterator[Frame]:
    """The frames of a sweep by the rail, to its end: their delivery may lag behind it."""
    over = np.inf
    for frame in frames:
        if sweep.done and over == np.inf:
            sweep.wait(1.0)
            over = sweep.window[1]
        if frame.mid_exposure > over:
            return
        yield frame


@dataclass(eq=False)
class SweepCollector:
    """Takes the frames of one sweep: keeps them, triangulates their profiles, remembers when they were exposed."""

    geometry: ScanGeometry
    scan: ScanSection
    keep_frame: Callable[[Frame, Cut | None], None]
    progress: Callable[[float, str], None]
    keep_profile: Callable[[StripeProfile], None] | None = None
    times: list[float] = field(default_factory=list)
    received: list[float] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    frame_ids: list[int] = field(default_factory=list)
    notes: tuple[str, ...] = ()
    whitest: Frame | None = None
    white: int = 0
    middle: tuple[Frame, StripeProfile] | None = None
    lost: int = 0

    def __post_init__(self) -> None:
        self.expected = self.scan.length / self.scan.speed * self.scan.frame_rate
        self.stripes = StripeStream()
        self.builder = ProfileBuilder(self.geometry, int(1.3 * self.expected) + 32)

    def take(self, frames: FrameStream, ended: Callable[[], float | None]) -> None:
        """Take frames until one was exposed after the time that `ended` gives once the motion is over: their delivery
        may lag behind it."""
        for frame in frames:
            end = ended()
            if end is not None and frame.mid_exposure > end:
                break
            cut = None
            try:
                cut = self.see(frame)
            finally:
                self.keep_frame(frame, cut)
            self.progress(min(0.99, len(self.times) / self.expected), f"{len(self.times)} profiles")
        self.lost = frames.lost

    def see(self, frame: Frame) -> Cut | None:
        """Triangulate the stripe of one frame. Gives what makes the picture that is kept of it; None for the whole."""
        image = frame.image
        if self.notes and bearable(frame) * WHITER <= frame.exposure:
            # A shadow has moved away: nothing is to be seen in white.
            self.white, self.whitest, image = self.white + 1, frame, np.zeros_like(image)
        like = self.stripes.like
        profile = self.stripes.extract(image)
        if self.keep_profile is not None:
            self.keep_profile(profile)
        self.counts.append(self.builder.see(profile))
        self.times.append(frame.mid_exposure)
        self.received.append(frame.received)
        self.frame_ids.append(frame.frame_id)
        if self.middle is None and len(self.times) >= self.expected / 2:
            self.middle = frame, profile
            return None
        if self.notes or like is None or like.noise is None:
            return None
        return partial(around_stripe, image, profile, like)

    def require_frames(
        self, camera: str, lines: NDArray[np.intp], most_lost: float = MAX_LOST_FRACTION
    ) -> tuple[Frame, StripeProfile]:
        """The middle frame and profile; raises `DeviceFault` without a line or with a larger share of frames lost."""
        if not len(lines) or self.middle is None or self.lost > most_lost * self.expected:
            raise DeviceFault(
                camera, FRAMES_LOST,
                f"{len(lines)} frames came from the sweep and {self.lost} were lost, of about {self.expected:.0f}",
                recoverable=True, hint="Lower scan.frame_rate or look at the camera's link.",
            )  # fmt: skip
        return self.middle

    def require_one_clock(self, camera: str, errors: SweepErrors) -> None:
        """Raise `DeviceFault` where the camera's clock stepped meanwhile."""
        allowed = STEP_SHARE * errors.shift
        require_one_clock(camera, self.frame_ids, self.times, self.received, speed=self.scan.speed, most=allowed)


@dataclass(frozen=True, eq=False)
class Sweeping:
    """Who takes its frames, where the surface is by the board before anything was registered, and the surface."""

    collector: SweepCollector
    base_from_surface: pin.SE3
    nominal: NominalSurface
