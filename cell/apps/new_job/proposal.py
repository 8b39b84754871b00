"""The scan that is proposed: how high, how long, how many sweeps side by side, and tilted ones where they tell more.

The head is set so that the middle of the surface lies where its camera is sharp and was calibrated. Straight sweeps
cover the surface; a tilted one is added when straight ones leave a motion of the surface open, or much of it unseen.
That is told before anything is swept, by the same inversion that a job does, on the points that the sweeps will see of
the drawn surface; and whether what the claw holds is in the way of light and sight, of scan and board's photograph.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.apps.new_job.surface import Laid, open_side
from cell.apps.new_job.sweeps import ABOVE, FARTHEST, NEAREST, Array, Rays, SeenSurface, as_cloud, visible_surfaces
from cell.check.fit import RAMP_MARGIN
from cell.config.cell_config import CALIBRATION_DEPTHS, CellConfig, mounted
from cell.config.job import Job, ScanSection, SwathSection
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface, PlacePose, Prior, Tolerance, invert_pose
from cell.measure.inversion.observability import FREE, PoseVerdict, judge
from cell.measure.reconstruction.build import flange_motions
from cell.measure.vision.board.view import parse_board
from cell.motion.collision import Body, tool_bodies
from cell.procedures.arm.photograph import base_from_place_at_target, look_pose, photo_pose
from drivers.errors import ConfigError

MOST_HIDDEN = 0.02
"""Share of the scanned points that may be hidden behind what the claw holds."""
MARGIN = 0.002
"""How much larger the part is taken to be on each side, m."""


def sight_problems(job: Job, config: CellConfig, seen: Sequence[SeenSurface]) -> Iterator[str]:
    """A line for each view that the part in the claw, as drawn, hides."""
    part = tool_bodies(job.grasp.size, job.grasp.flange_from_part.se3(), mounted(config))[-1]
    sides = " x ".join(f"{1e3 * side:g}" for side in job.grasp.size)
    held = f"the part in the claw ({sides} mm, grasp.size)"
    hidden = [_hidden_share(each, part) for each in seen]
    if hidden and max(hidden) > MOST_HIDDEN:
        yield (
            f"sweep {int(np.argmax(hidden)) + 1}: {held} hides {100 * max(hidden):.0f} % of it from the scan camera or "
            f"the laser (allowed: {100 * MOST_HIDDEN:g} %); give the part's own size with --part-size, or hold it "
            "otherwise with --grasp"
        )
    board = parse_board(job.board.spec)
    base_from_place = base_from_place_at_target(config, job)
    hand = config.target_camera.flange_from_camera.se3()
    base_from_board = base_from_place * job.place_from_board
    for what, flange in (
        ("while the vehicle drives", look_pose(config, job, board, hand)),
        ("in the photograph", photo_pose(job, board, base_from_board, hand)),
    ):
        points = transform(flange.inverse() * base_from_board, board.points())
        eyes = np.tile(hand.translation, (len(points), 1))
        if (count := int(_crosses(eyes, points, part).sum())) > 0:
            yield (
                f"{held} hides {count} of {len(points)} points of the board from the target camera {what}; give the "
                "part's own size with --part-size, or hold it otherwise with --grasp"
            )
            return


def _hidden_share(seen: SeenSurface, part: Body) -> float:
    lines, rows = seen.valid.nonzero()
    if not len(lines):
        return 0.0
    every = max(1, len(lines) // 4000)
    lines, rows = lines[::every], rows[::every]
    flanges = seen.flanges[lines]

    def on_flange(points: Array) -> Array:
        return np.asarray(np.einsum("nji,nj->ni", flanges[:, :3, :3], points - flanges[:, :3, 3]))

    points = on_flange(seen.points[lines, rows])
    hidden = _crosses(on_flange(seen.eyes[lines]), points, part) | _crosses(on_flange(seen.lamps[lines]), points, part)
    return float(hidden.mean())


def _crosses(starts: Array, ends: Array, body: Body) -> NDArray[np.bool_]:
    """(n,) whether the way from start to end, flange frame, leads through the box."""
    into: pin.SE3 = body.placement.inverse()
    a, b = transform(into, starts), transform(into, ends)
    half = 0.5 * np.array(body.size) + MARGIN
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half - a) / (b - a), (half - a) / (b - a)
    enter = np.nanmax(np.minimum(first, second), axis=1)
    leave = np.nanmin(np.maximum(first, second), axis=1)
    return np.asarray((enter < leave) & (leave > 0.0) & (enter < 1.0))


OVER = 1e-4
"""How far points of the drawing may lie from the surface that was cut out of it, m."""
FEW = 0.03
"""Share of the points that has to tell a shift: with less, on upright faces, true errors of six sigma were seen."""
BARELY = 1.5
"""So many times what the inversion takes for no information counts as none here: a scan may bring less than drawn."""


def prior_of(job: Job) -> Array:
    """Covariance (6, 6) of where the board puts the surface, S, m² and rad²."""
    surface = job.surface
    return np.diag([surface.prior_sigma**2] * 3 + [surface.prior_sigma_angle**2] * 3)


def shared_by_all(config: CellConfig) -> Array:
    """Covariance (6, 6) of what all points have in common: the arm's geometry as configured, m² and rad²."""
    arm = config.arm
    return np.diag([arm.kinematic_sigma**2] * 3 + [arm.kinematic_sigma_angle**2] * 3)


def verdict(information: Array, points: int, radius: float, job: Job, config: CellConfig) -> PoseVerdict:
    """What a scan of this information (6, 6) in `points` points leaves open. A motion that the scan hardly determines
    is left to the board altogether: what there is of it may be noise, or the drawing's facets."""
    length = np.array([1.0] * 3 + [radius] * 3)
    variance = points / max(float(np.trace(information[:3, :3])), 1e-9)
    spectrum, ways = np.linalg.eigh(information / np.outer(length, length))
    spectrum = np.where(spectrum * variance / points < BARELY * FREE, 0.0, spectrum)
    information = (ways * spectrum) @ ways.T * np.outer(length, length)
    known = np.linalg.inv(information + np.linalg.inv(prior_of(job)))
    gain = known @ information
    covariance = known + gain @ shared_by_all(config) @ gain.T
    return judge(covariance, information, variance, points=points, radius=radius, tolerance=_tolerance(job))


def known(seen: Sequence[SeenSurface], surface: NominalSurface, job: Job, config: CellConfig) -> PoseVerdict:
    """What these sweeps leave open, by the points that the inversion uses: those over `surface`, not at its borders."""
    used = [each.valid for each in seen]
    for mask, each in zip(used, seen, strict=True):
        index, feet = surface.feet(each.points[mask], OVER)
        over = np.zeros(int(mask.sum()), dtype=np.bool_)
        over[index] = feet.inner
        mask[mask] = over
    information = sum((each.information(mask) for each, mask in zip(seen, used, strict=True)), np.zeros((6, 6)))
    return verdict(information, sum(int(mask.sum()) for mask in used), surface.radius, job, config)


def told_by_few(seen: Sequence[SeenSurface], surface: NominalSurface) -> list[str]:
    """A line for x and for y where few points alone tell how the surface lies along it: those on upright faces."""
    points = np.concatenate([each.points[each.valid] for each in seen])
    normals = np.concatenate([each.normals[each.valid] for each in seen])
    index, feet = surface.feet(points, OVER)
    notes = []
    for k, axis in enumerate("xy"):
        weights = normals[index[feet.inner], k] ** 2
        share = float(weights.sum() ** 2 / max(1e-12, len(weights) * float((weights**2).sum())))
        if share < FEW:
            notes.append(
                f"how the surface lies along {axis} is told by {100 * share:.1f} % of the points alone, upright ones "
                f"(relief: {100 * FEW:g} % or more): the stated error may be too small there; prefer a side with relief"
            )
    return notes


def place_from(seen: Sequence[SeenSurface], nominal: NominalSurface, job: Job, config: CellConfig) -> PlacePose:
    """The place as the job's own inversion would tell it from these sweeps, without noise. Raises `NotObservable` that
    names the motion which surface and sweeps leave open, `RefusedError` when they cover too little of the surface."""
    cloud = as_cloud(list(seen), config.calibration.rail_sigma).require()
    arm = config.arm
    rest = np.diag([arm.repeatability**2] * 3 + [arm.repeatability_angle**2] * 3)
    return invert_pose(
        cloud, nominal, Prior(pin.SE3.Identity(), prior_of(job)), _tolerance(job), systematic=shared_by_all(config),
        sweeps=lambda lines, rows: flange_motions(cloud, lines, rows, [rest] * len(seen)),
    )  # fmt: skip


def _tolerance(job: Job) -> Tolerance:
    return Tolerance(job.place.tolerance, job.place.tolerance_angle)


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
    (25, 0), (-25, 0), (0, 15), (0, -20), (25, 12), (25, -18), (-25, 12), (-25, -18)))  # fmt: skip
"""Rolls about the sweep's way and pitches about the stripe that are tried, rad."""
MOST_TILTED = 4
BETTER, SEES_MORE, ENOUGH = 0.67, 0.05, 0.5
"""A tilted sweep has to make the worst known motion so many times as large, or to see so much more of the surface;
enough is known when that motion, at three standard deviations, is within this share of the tolerance."""
LEAST_POINTS = 100
SEEN_WITHIN = 0.0025
"""A place of the surface is seen when a point lies this near, m: as the inversion counts it."""
UNSEEN = 0.10
"""Share of the surface that straight sweeps may leave unseen."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A job with its scan, what its sweeps see of the surface, and what was decided on the way, in words."""

    job: Job
    surface: Laid
    seen: tuple[SeenSurface, ...]
    notes: tuple[str, ...] = field(default=())
    open: bool = False
    """Whether a motion of the surface stays open, as far as the choice between sweeps tells."""

    @property
    def share(self) -> float:
        """Share of the surface's area that is seen, 0 … 1."""
        return seen_share(NominalSurface(self.surface.vertices, self.surface.faces), self.seen)


def propose(
    body: Laid, job: Job, config: CellConfig, step: float, reachable: Callable[[Job], str | None],
    notify: Callable[[str], None] = lambda text: None,
) -> Proposal:  # fmt: skip
    """A scan of what lies open of `body`, with lines `step` m apart.

    `reachable` says what keeps the arm from the poses of a job's sweeps, None when nothing does; `notify` gets the
    progress of the choice. Raises `ConfigError` when the surface is too deep, too wide or too long for this scan head.
    """
    top = open_side(body, notify=notify)
    scan, notes = _straight(top, job.scan, config, step)
    search = _Search(
        config, Rays(body.vertices, body.faces), NominalSurface(top.vertices, top.faces), reachable, notify
    )
    straight = _with(job, scan)
    notify(f"what {len(scan.swath)} straight sweeps see")
    seen = visible_surfaces(config, straight, search.rays)
    job, seen, more, excess = search.tilted(straight, seen)
    ways = [ABOVE, *(way(swath) for swath in job.scan.swath if swath.roll or swath.pitch)]
    surface = top if len(ways) == 1 else open_side(body, ways, notify)
    return Proposal(job, surface, tuple(seen), (*notes, *more), excess > 1.0)


def _with(job: Job, scan: ScanSection) -> Job:
    return job.model_copy(update={"scan": scan})


def _straight(surface: Laid, like: ScanSection, config: CellConfig, step: float) -> tuple[ScanSection, list[str]]:
    low, high = surface.box
    notes = []
    stand_off = _stand_off(float(low[2]), float(high[2]))
    # The light comes aslant: what lies higher is lit earlier on the way.
    length = float(high[0] - low[0]) - 2 * END + float(high[2] - low[2]) / config.laser.tan_theta
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
            "mm: the stripe is sharp and calibrated so far); give its --unit, cut the mesh to what the part is placed "
            "onto, or turn it with --up"
        )
    return stand_off


def _pace(length: float, count: int, rate: float, step: float) -> tuple[float, float, float]:
    """Speed (m/s) and frame rate (Hz) for lines `step` m apart, and the time that all sweeps take, s: no faster than
    the job that this one is like, as long as there is time."""
    wanted = count * length / step / max(LONGEST_S - count * PER_SWEEP_S, 1.0)
    rate = max(rate, min(MOST_FRAMES_HZ, math.ceil(wanted)))
    speed = step * rate
    return speed, rate, count * (length / speed + PER_SWEEP_S)


@dataclass(eq=False)
class _Search:
    """Looks for tilted sweeps of the mesh that `rays` meet; `top` is what straight ones are to see of it."""

    config: CellConfig
    rays: Rays
    top: NominalSurface
    reachable: Callable[[Job], str | None]
    notify: Callable[[str], None]

    def tilted(self, job: Job, seen: list[SeenSurface]) -> tuple[Job, list[SeenSurface], list[str], float]:
        """With tilted sweeps added as long as each makes the worst known motion better known by a third, or sees more
        of the surface; in words what was added and what was not; and the worst known motion, in tolerances."""
        worst, missed = self._excess(job, seen), self._missed(seen)
        if worst <= 1.0 and missed <= UNSEEN:
            return job, seen, [], worst
        why = (
            f"straight sweeps leave {100 * missed:.0f} % of the surface unseen"
            if worst <= 1.0
            else "straight sweeps leave a motion of the surface open"
        )
        left = {}
        for k, tilt in enumerate(TILTS):
            self.notify(f"tilted sweep {k + 1} of {len(TILTS)}, {_words(*tilt)}")
            left[tilt] = self._one(job, *tilt)
        refused: list[str] = []
        added: list[str] = []
        while left and len(added) < MOST_TILTED and (worst > ENOUGH or missed > UNSEEN):
            tried = {}
            for tilt, one in left.items():
                self.notify(f"which of {len(left)} tilted sweeps tells most, {len(added)} added so far")
                tried[tilt] = self._excess(job, [*seen, one]), self._missed([*seen, one])
            tilt = min(tried, key=lambda each: tried[each][0] if worst > ENOUGH else tried[each][1])
            excess, unseen = tried[tilt]
            if not (excess < BETTER * worst or unseen < missed - SEES_MORE):
                break
            with_it = _with(job, _and_tilted(job.scan, *tilt))
            one = left.pop(tilt)
            if (problem := self.reachable(with_it)) is not None:
                refused.append(f"no sweep with {_words(*tilt)}: {problem}")
                continue
            job, seen, worst, missed = with_it, [*seen, one], excess, unseen
            added.append(_words(*tilt))
        told = f"tilted ones added ({'; '.join(added)})" if added else "tilted ones tell no more"
        return job, seen, [f"{why}: {told}", *refused[:2]], worst

    def _one(self, job: Job, roll: float, pitch: float) -> SeenSurface:
        """What the tilted sweep alone sees."""
        swath = _and_tilted(job.scan, roll, pitch).swath[-1:]
        return visible_surfaces(self.config, _with(job, job.scan.model_copy(update={"swath": swath})), self.rays)[0]

    def _missed(self, seen: Sequence[SeenSurface]) -> float:
        """Share of the surface's area, 0 … 1, that no sweep sees."""
        return 1.0 - seen_share(self.top, seen)

    def _excess(self, job: Job, seen: Sequence[SeenSurface]) -> float:
        """3σ of the least known motion, in tolerances."""
        used = [each.solid for each in seen]
        if (points := sum(int(mask.sum()) for mask in used)) < LEAST_POINTS:
            return math.inf
        information = sum((each.information(mask) for each, mask in zip(seen, used, strict=True)), np.zeros((6, 6)))
        return verdict(information, points, self.top.radius, job, self.config).worst.excess


def _and_tilted(scan: ScanSection, roll: float, pitch: float) -> ScanSection:
    swath = SwathSection.model_construct(across=0.0, roll=roll, pitch=pitch)
    return scan.model_copy(update={"swath": (*scan.swath, swath)})


def _words(roll: float, pitch: float) -> str:
    return " and ".join(
        f"{name} {math.degrees(angle):.0f} deg" for name, angle in (("roll", roll), ("pitch", pitch)) if angle
    )


def way(swath: SwathSection) -> Array:
    """The unit direction (3,), S, from which a sweep's camera looks."""
    return np.asarray(pin.rpy.rpyToMatrix(swath.roll, swath.pitch, 0.0) @ ABOVE)


def seen_share(surface: NominalSurface, seen: Sequence[SeenSurface]) -> float:
    """Share of the surface's area that has a point of a sweep near it."""
    points = np.concatenate([each.points[each.valid] for each in seen])
    return surface.coverage(points, SEEN_WITHIN) if len(points) else 0.0
