"""The scan that is proposed: how high, how long, how many sweeps side by side, and tilted ones where they tell more.

The head is set so that the middle of the surface lies where its camera is sharp and was calibrated. Straight sweeps
cover the surface; a tilted one is added when straight ones leave a motion of the surface open, or much of it unseen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from cell.check.fit import CALIBRATION_DEPTHS, RAMP_MARGIN
from cell.config import CellConfig
from cell.inversion import NominalSurface
from cell.job import Job, ScanSection, SwathSection
from cell.new_job.knowledge import verdict
from cell.new_job.rays import ABOVE, Array, Rays
from cell.new_job.surface import Laid, open_side
from cell.new_job.sweeps import Seen, look
from drivers.errors import ConfigError

NEAREST, FARTHEST = 0.100, 0.165
"""How near and how far, m, a surface may be from the scan camera: beyond, its stripe is too broad, and too far from the
depths at which the head is calibrated."""
OVERLAP = 0.008
"""How much neighbouring sweeps see twice, m: what the surface may lie beside its place, and what ties them together."""
BESIDE = 0.001
"""Left out at each side of a sweep, m: the surface does not lie exactly where it is drawn."""
NARROW = 0.93
"""Share of the surface's width that one sweep has to see for one to be enough."""
END = 0.002
"""By how much a sweep is shorter than the surface at each end, m: there it would see the border only."""
LONGEST_S, PER_SWEEP_S = 90.0, 4.0
"""Time for all sweeps, and for the arm's way to each: the step has 120 s."""
MOST_FRAMES_HZ = 60.0
MOST_SWEEPS = 20
TILTS = tuple((math.radians(roll), math.radians(pitch)) for roll, pitch in (
    (25, 0), (-25, 0), (0, 15), (0, -15), (25, 12), (25, -12), (-25, 12), (-25, -12)))  # fmt: skip
"""Rolls about the sweep's way and pitches about the stripe that are tried, rad."""
MOST_TILTED = 4
SEEN_WITHIN = 0.0025
"""A place of the surface is seen when a point lies this near, m: as the inversion counts it."""
UNSEEN = 0.10
"""Share of the surface that straight sweeps may leave unseen."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A job with its scan, what its sweeps see of the surface, and what was decided on the way, in words."""

    job: Job
    surface: Laid
    seen: tuple[Seen, ...]
    notes: tuple[str, ...] = field(default=())


def propose(
    body: Laid, job: Job, config: CellConfig, step: float, reachable: Callable[[Job, Laid], str | None]
) -> Proposal:
    """A scan of what lies open of `body`, with lines `step` m apart.

    `reachable` says what keeps the arm from the poses of a job's sweeps, None when nothing does. Raises `ConfigError`
    when the surface is too deep, too wide or too long for this scan head.
    """
    surface = open_side(body)
    scan, notes = _straight(surface, job.scan, config, step)
    straight = _with(job, scan)
    seen = look(config, straight, Rays(surface.vertices, surface.faces))
    made = Proposal(straight, surface, tuple(seen), tuple(notes))
    return _tilted(made, body, config, reachable)


def _with(job: Job, scan: ScanSection) -> Job:
    return job.model_copy(update={"scan": scan})


def _straight(surface: Laid, like: ScanSection, config: CellConfig, step: float) -> tuple[ScanSection, list[str]]:
    low, high = surface.box
    notes = []
    stand_off = _stand_off(float(low[2]), float(high[2]))
    length = float(high[0] - low[0]) - 2 * END
    width = float(high[1] - low[1])
    camera = config.scan_camera
    seen = camera.height * camera.pixel / camera.focal_length * (stand_off - float(high[2])) - 2 * BESIDE
    count = 1 if seen >= NARROW * width else math.ceil((width - seen) / (seen - OVERLAP)) + 1
    if count > MOST_SWEEPS:
        raise ConfigError(
            f"the surface is {1e3 * width:.0f} mm wide, one sweep {1e3 * seen:.0f} mm: {count} sweeps side by side "
            f"(allowed: at most {MOST_SWEEPS}); cut the mesh to what the part is placed onto"
        )
    edge = 0.5 * (width - seen)
    across = [0.0] if count == 1 else [-edge + 2 * edge * k / (count - 1) for k in range(count)]
    speed, rate, time = _pace(length, count, like.frame_rate, step)
    if time > LONGEST_S:
        raise ConfigError(
            f"{count} sweeps of {1e3 * length:.0f} mm with lines {1e3 * step:g} mm apart take {time:.0f} s (allowed: "
            f"at most {LONGEST_S:g} s); give a larger --step, or cut the mesh to what the part is placed onto"
        )
    rail = config.rail
    longest = rail.travel[1] - rail.travel[0] - speed**2 / rail.acceleration - 2 * RAMP_MARGIN
    mode = "rail" if length <= longest and speed <= rail.max_speed else "arm"
    if mode == "arm":
        notes.append(
            f"swept by the arm: {1e3 * length:.0f} mm are longer than the rail's {1e3 * longest:.0f} mm"
            if length > longest
            else f"swept by the arm: {1e3 * speed:.0f} mm/s are faster than the rail's {1e3 * rail.max_speed:.0f} mm/s"
        )
    if count > 1:
        notes.append(f"{count} sweeps side by side: one sees {1e3 * seen:.0f} mm of {1e3 * width:.0f} mm")
    swaths = tuple(SwathSection.model_construct(across=round(y, 5), roll=0.0, pitch=0.0) for y in across)
    made = like.model_copy(
        update={"stand_off": stand_off, "length": round(length, 4), "speed": round(speed, 5), "frame_rate": rate,
                "mode": mode, "swath": swaths}
    )  # fmt: skip
    return made, notes


def _stand_off(low: float, high: float) -> float:
    """Of the scan camera over the surface's origin: the middle of the surface where the head is best. Whole mm."""
    best = CALIBRATION_DEPTHS["fine"][1]
    stand_off = round(best + 0.5 * (low + high), 3)
    near, far = stand_off - high, stand_off - low
    if near < NEAREST or far > FARTHEST:
        deepest = 2 * min(best - NEAREST, FARTHEST - best)
        raise ConfigError(
            f"the surface is {1e3 * (high - low):.0f} mm deep as seen from above (allowed: at most {1e3 * deepest:.0f} "
            "mm: the stripe is sharp and calibrated so far); cut the mesh to what the part is placed onto, or turn it "
            "with --up"
        )
    return stand_off


def _pace(length: float, count: int, rate: float, step: float) -> tuple[float, float, float]:
    """Speed (m/s) and frame rate (Hz) for lines `step` m apart, and the time that all sweeps take, s: no faster than
    the job that this one is like, as long as there is time."""
    wanted = count * length / step / max(LONGEST_S - count * PER_SWEEP_S, 1.0)
    rate = max(rate, min(MOST_FRAMES_HZ, math.ceil(wanted)))
    speed = step * rate
    return speed, rate, count * (length / speed + PER_SWEEP_S)


def _tilted(made: Proposal, body: Laid, config: CellConfig, reachable: Callable[[Job, Laid], str | None]) -> Proposal:
    """Tilted sweeps, one after the other, as long as each makes the worst known motion better known by a third."""
    worst = _excess(made, config)
    missed = _missed(made)
    if worst <= 1.0 and missed <= UNSEEN:
        return made
    why = (
        f"straight sweeps leave {100 * missed:.0f} % of the surface unseen"
        if worst <= 1.0
        else "straight sweeps leave a motion of the surface open"
    )
    refused: dict[str, str] = {}
    added: list[str] = []
    while len(added) < MOST_TILTED:
        tried = [(_excess(other, config), other, words) for other, words in _others(made, body, config)]
        tried.sort(key=lambda each: each[0])
        better = [each for each in tried if each[0] < 0.67 * worst or _missed(each[1]) < missed - 0.05]
        for excess, other, words in better:
            if (problem := reachable(other.job, other.surface)) is not None:
                refused[words] = problem
                continue
            made, worst, missed = other, excess, _missed(other)
            added.append(words)
            break
        else:
            break
        if worst <= 0.5 and missed <= UNSEEN:
            break
    notes = [*made.notes]
    notes.append(f"{why}: " + (f"tilted ones added ({'; '.join(added)})" if added else "tilted ones tell no more"))
    notes += [f"no sweep with {words}: {problem}" for words, problem in list(refused.items())[:2]]
    return replace(made, notes=tuple(notes))


def _others(made: Proposal, body: Laid, config: CellConfig) -> list[tuple[Proposal, str]]:
    """The proposal with one tilted sweep more, each."""
    found = []
    present = {(s.roll, s.pitch) for s in made.job.scan.swath}
    for roll, pitch in TILTS:
        if (roll, pitch) in present:
            continue
        swath = SwathSection.model_construct(across=0.0, roll=roll, pitch=pitch)
        scan = made.job.scan.model_copy(update={"swath": (*made.job.scan.swath, swath)})
        job = _with(made.job, scan)
        surface = open_side(body, [ABOVE, *(way(s) for s in scan.swath)])
        seen = look(config, job, Rays(surface.vertices, surface.faces))
        words = " and ".join(
            f"{name} {math.degrees(angle):.0f} deg" for name, angle in (("roll", roll), ("pitch", pitch)) if angle
        )
        found.append((Proposal(job, surface, tuple(seen), made.notes), words))
    return found


def way(swath: SwathSection) -> Array:
    """The unit direction (3,), S, from which a sweep's camera looks."""
    return np.asarray(pin.rpy.rpyToMatrix(swath.roll, swath.pitch, 0.0) @ ABOVE)


def _excess(made: Proposal, config: CellConfig) -> float:
    """3σ of the least known motion, in tolerances."""
    points = np.concatenate([each.points[each.valid] for each in made.seen])
    if len(points) < 100:
        return math.inf
    information = sum((each.information() for each in made.seen), np.zeros((6, 6)))
    radius = float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))
    return verdict(information, len(points), radius, made.job, config).worst.excess


def _missed(made: Proposal) -> float:
    """Share of the surface's area, 0 … 1, that no sweep sees."""
    return 1.0 - seen_share(made.surface, made.seen)


def seen_share(surface: Laid, seen: Sequence[Seen]) -> float:
    """Share of the surface's area that has a point of a sweep near it."""
    points = np.concatenate([each.points[each.valid] for each in seen])
    if not len(points):
        return 0.0
    return NominalSurface(surface.vertices, surface.faces).coverage(points, SEEN_WITHIN)
