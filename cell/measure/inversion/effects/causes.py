"""Why a scan does not fit its surface: its residuals as functions of line (time), row and place on the surface.

A jump at one line is the laser's, the frames' or the carriage's; a ramp over the lines is drift; a sine is vibration.
What is fixed to the surface is wear or oil, what stays with the rows is the sensor's. Each model is fitted together
with the pose; BIC compares them (docs/explanation/theory.md, section 8). No scan is accepted for it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Self

import numpy as np
import pinocchio as pin

from cell.measure.geometry.poses import perturbed
from cell.measure.inversion.effects.during_sweep import LARGEST_OVERTONES
from cell.measure.inversion.nominal import Array, NominalSurface, Scan, correspondences
from cell.measure.inversion.place_pose import PATCH_M
from cell.measure.inversion.registration import across
from cell.measure.reconstruction.cloud import Cloud

GATE_M, MOST_POINTS = 1.5e-3, 30_000
ROW_GROUPS = 24
LEAST_POINTS, LEAST_CELLS, LEAST_LINES = 4, 200, 20
"""Of a cell (one line, one group of rows); of a scan that is judged."""
EXPLAINS = 0.5
"""Share of the residuals' squares that the best cause explains at least."""
PATCH_RADII, PATCH_STEP = (5e-3, 8e-3, 12e-3, 18e-3), 3e-3
PATCH_SHAPES = (2, 8)
"""Powers of the distance from its middle by which a patch falls off: worn round, or flat to its rim as a puddle is."""
WAVES = 6
"""Cosines along each side of the surface, and over the rows."""
ROUGHER = 1.6
"""A patch whose points scatter so many times as much as the others reflects."""
MOST_TURN = 3e-3
"""By more, rad, no vehicle creeps during a sweep or rocks: a bow of the surface looks like that."""
WHOLE = 0.2
"""A jump this near to whole distances between lines is one of whole frames."""
AGAIN = {
    "surface": "stays at its place of the surface",
    "rows": "stays with the camera's rows",
    "line": "stays at its line or is gone",
}
"""What each does when the surface is swept again from elsewhere."""
APART = {
    frozenset({"laser", "along"}): "sweep at half the speed: a jump of the laser also shows on level ground, one of "
    "the carriage on slopes only and as far as before, one of whole frames half as far",
    frozenset({"laser", "push"}): "run `cell calibrate verify`: a laser that jumped shows on the plate on the claw",
    frozenset({"along", "push"}): "photograph the board: after a push it lies elsewhere; else home the rail, which "
    "shows lost steps, and look at the frames' numbers",
    frozenset({"sway", "drift"}): "photograph the board ten times in a minute: it goes to and fro, or away",
    frozenset({"patch", "bent"}): "wipe the surface and sweep again: what stays is worn or bent",
}
USUAL = "sweep again at half the speed: the carriage's stays at its line, the vehicle's at its time"


@dataclass(frozen=True)
class Cause:
    """One cause by its `kind` and in `words`; `fixed` to a "line", the "surface" or the "rows"; its `bic`, and the
    share of the residuals' squares that it `explains`."""

    kind: str
    words: str
    fixed: str
    bic: float
    explains: float


def likeliest(causes: list[Cause]) -> str:
    """For people: the best cause, the next and what tells them apart; empty without any."""
    told = [f"{cause.words} ({100 * cause.explains:.0f} % of the pattern)" for cause in causes[:2]]
    if len(told) < 2:
        return f"Likeliest cause: {told[0]}" if told else ""
    first, second = causes[:2]
    apart = APART.get(frozenset({first.kind, second.kind}), USUAL)
    if first.fixed != second.fixed:
        apart = (
            f"sweep again from 5 mm beside and further on: the first {AGAIN[first.fixed]}, the second "
            f"{AGAIN[second.fixed]}"
        )
    return f"Likeliest cause: {told[0]}. Next likely: {told[1]}. To tell them apart, {apart}"


def find_causes(
    cloud: Cloud, nominal: NominalSurface, base_from_surface: pin.SE3, times: Array, base_from_vehicle: pin.SE3
) -> list[Cause]:
    """What puts a scan's lines, taken at `times` (lines,) s, off the surface at the pose found: causes, the best first,
    one of each kind; empty where none explains enough."""
    cells = _Cells.of(cloud, nominal, base_from_surface, times, base_from_vehicle)
    if cells is None:
        return []
    found = [cells.judged(*model) for model in (*cells.steps(), *cells.slow(), *cells.fixed())]
    # A jump along the sweep takes points far beside where they belong: it is undone, and the rest seen from there.
    line, size, pose = cells.jump(base_from_surface)
    late = np.where(np.arange(cloud.shape[0]) >= line, size, 0.0)[:, None] * _ahead(cloud)
    near = _Cells.of(replace(cloud, points=cloud.points - late[:, None]), nominal, pose, times, base_from_vehicle)
    if near is not None:
        along = next(cause for cause in found if cause.kind == "along")
        again = near.judged("along", along.words, "line", (near.along * (near.lines >= line))[:, None], 1)
        found.append(replace(again, explains=1.0 - (1.0 - again.explains) * near.mean_square / cells.mean_square))
    nothing = cells.judged("", "", "", np.zeros((len(cells.heights), 0)), 0)
    best: dict[str, Cause] = {}
    for cause in sorted(found, key=lambda each: each.bic):
        if cause.bic < nothing.bic:
            best.setdefault(cause.kind, cause)
    return list(best.values()) if best and next(iter(best.values())).explains >= EXPLAINS else []


Model = tuple[str, str, str, Array, int]
"""Kind, words, what it is fixed to, columns (cells, m), and how many numbers were searched for beside their sizes."""
Tries = Iterator[tuple[tuple[float, ...], Array]]


@dataclass(frozen=True, eq=False)
class _Cells:
    """Medians over n cells, each one line by one group of rows.

    heights: (n,) m over the surface, less what the pose explains; raw: with it; poses: (n, 6) their derivatives by the
    pose; free: (n, k) orthonormal columns of the poses of the sweeps; lines: (n,) numbers; times: (n,) s from the
    middle; rows: (n,) -1 … 1; places: (n, 3) m, surface frame; sides: (2, 3) axes across it; scatter: (n,) m from
    point to point; normals, turns: (n, 3) what a shift and a turn about the vehicle do to the heights; along, ray: (n,)
    the same of a shift along the sweep and along the camera's ray; pitch, rate: m and Hz from line to line.
    """

    heights: Array
    raw: Array
    poses: Array
    free: Array
    lines: Array
    times: Array
    rows: Array
    places: Array
    sides: Array
    scatter: Array
    normals: Array
    turns: Array
    along: Array
    ray: Array
    pitch: float
    rate: float

    @classmethod
    def of(
        cls, cloud: Cloud, nominal: NominalSurface, pose: pin.SE3, times: Array, base_from_vehicle: pin.SE3
    ) -> Self | None:
        # However many lines there are, each has enough for its cells.
        most = max(MOST_POINTS, 2 * LEAST_POINTS * ROW_GROUPS * cloud.shape[0])
        scan, (lines, rows) = Scan.of(cloud, most), cloud.subsample(most)
        found = correspondences(pose, scan, nominal, GATE_M)
        line, row, normals, points = lines[found.index], rows[found.index], found.normals, scan.points[found.index]
        cell = line * ROW_GROUPS + row * ROW_GROUPS // cloud.shape[1]
        _, owner, count = np.unique(cell, return_inverse=True, return_counts=True)
        many = count >= LEAST_POINTS
        if np.count_nonzero(many) < LEAST_CELLS or len(np.unique(line)) < LEAST_LINES:
            return None

        def mean(*values: Array) -> Array:
            sums = [np.bincount(owner, column)[many] for column in np.column_stack(values).T]
            return np.asarray(np.stack(sums, axis=-1) / count[many, None])

        groups = np.split(found.heights[np.argsort(owner, kind="stable")], np.cumsum(count)[:-1])
        raw = np.array([np.median(each) for each in groups])
        scatter = [np.median(np.abs(np.diff(each))) for each, good in zip(groups, many, strict=True) if good]
        raw = raw[many]
        sweeps = cloud.sweep_of[line]
        at = mean(line.astype(np.float64), times[line], row.astype(np.float64), sweeps.astype(np.float64))
        poses = mean(found.jacobian)
        # Each sweep has a pose of its own: what that is off by is no cause.
        own = np.round(at[:, 3])
        free = np.linalg.qr(np.hstack([poses * (own == k)[:, None] for k in np.unique(own)]))[0]
        ray = np.einsum("ni,ni->n", scan.stripe_spread[found.index], normals)
        ray = ray / np.maximum(np.linalg.norm(scan.stripe_spread[found.index], axis=1), 1e-12)
        ways = np.abs(np.diff(cloud.rail))
        if len(cloud.flanges) == cloud.shape[0]:
            ways = ways + np.linalg.norm(np.diff(cloud.flanges[:, :3, 3], axis=0), axis=1)
        return cls(
            heights=raw - free @ (free.T @ raw), raw=raw, poses=poses, free=free, lines=np.round(at[:, 0]),
            times=at[:, 1] - at[:, 1].mean(), rows=2.0 * at[:, 2] / cloud.shape[1] - 1.0,
            places=mean((points - pose.translation) @ pose.rotation), sides=across(nominal)[1],
            scatter=np.array(scatter), normals=mean(normals),
            turns=mean(np.cross(points - base_from_vehicle.translation, normals)),
            along=mean(np.einsum("ni,ni->n", _ahead(cloud)[line], normals))[:, 0], ray=mean(ray)[:, 0],
            pitch=max(1e-6, float(np.median(ways))), rate=1.0 / max(1e-6, float(np.median(np.abs(np.diff(times))))),
        )  # fmt: skip

    @property
    def mean_square(self) -> float:
        """Of the heights, m²."""
        return float(np.mean(self.heights**2))

    def fitted(self, columns: Array) -> tuple[float, Array]:
        """Sum of squares left, m², and the columns' sizes."""
        own = columns - self.free @ (self.free.T @ columns)
        sizes = np.linalg.lstsq(own, self.heights, rcond=None)[0]
        return float(np.sum((self.heights - own @ sizes) ** 2)), np.asarray(sizes)

    def judged(self, kind: str, words: str, fixed: str, columns: Array, searched: int) -> Cause:
        # Neighbouring cells share the drawing's facets and the part's form: as many tell as there are patches.
        n = len(np.unique(np.floor(self.places @ self.sides.T / PATCH_M), axis=0))
        left = self.fitted(columns)[0] / len(self.heights)
        bic = n * np.log(left) + (columns.shape[1] + searched) * np.log(n)
        return Cause(kind, words, fixed, float(bic), 1.0 - left / self.mean_square)

    def best(self, tries: Tries) -> tuple[tuple[float, ...], Array, Array]:
        """Of columns by what they were made with, those that leave least; and their sizes."""
        (_, sizes), key, columns = min(
            ((self.fitted(columns), key, columns) for key, columns in tries), key=lambda each: each[0][0]
        )
        return key, columns, sizes

    def stepped(self, columns: Array) -> tuple[float, Array, Array]:
        """The line at which a step of `columns` leaves least, the stepped columns and their sizes."""
        lines = np.unique(self.lines)
        margin = max(2, len(lines) // 12)
        tries = (((float(k),), columns * (self.lines >= k)[:, None]) for k in lines[margin:-margin])
        (line,), made, sizes = self.best(tries)
        return line, made, sizes

    def jump(self, pose: pin.SE3) -> tuple[float, float, pin.SE3]:
        """The line and the size in m of a jump along the sweep, and the pose beside it."""
        line, columns, _ = self.stepped(self.along[:, None])
        sizes = np.linalg.lstsq(np.hstack([self.poses, columns]), self.raw, rcond=None)[0]
        return line, float(sizes[6]), perturbed(pose, -sizes[:6])

    def steps(self) -> Iterator[Model]:
        line, columns, sizes = self.stepped(self.ray[:, None])
        words = f"the laser jumped by {1e3 * abs(sizes[0]):.2f} mm along the camera's rays (mode hop, loose mount)"
        yield "laser", f"{words} at line {line:.0f}", "line", columns, 1
        line, columns, sizes = self.stepped(self.along[:, None])
        frames = sizes[0] / self.pitch
        words = f"the carriage jumped against its count by {-1e3 * sizes[0]:+.2f} mm (lost steps, coupling)"
        if round(frames) and abs(frames - round(frames)) < WHOLE:
            words = f"the frames come {abs(round(frames))} {'late' if frames > 0 else 'early'} (lost, or stamped anew)"
        yield "along", f"{words} from line {line:.0f} on", "line", columns, 1
        line, columns, _ = self.stepped(np.hstack([self.normals, self.turns]))
        yield "push", f"vehicle, arm or surface was pushed at line {line:.0f}", "line", columns, 1

    def slow(self) -> Iterator[Model]:
        t, span = self.times[:, None], float(np.ptp(self.times))
        creeping = t * np.hstack([self.normals, self.turns])
        if np.linalg.norm(self.fitted(creeping)[1][3:]) * span < MOST_TURN:
            yield "drift", "vehicle, floor or surface creeps", "line", creeping, 0
        yield "warming", "laser or camera warms and points elsewhere", "line", t * self.ray[:, None], 0

        def shaken(hz: float) -> Array:
            return np.hstack([wave(2 * np.pi * hz * t) * self.turns[:, :2] for wave in (np.sin, np.cos)])

        tries = np.arange(0.4 / span, 0.45 * self.rate, 0.15 / span)
        (hz,), columns, sizes = self.best(((float(hz),), shaken(hz)) for hz in tries)
        left, both = self.fitted(columns)[0], self.fitted(np.hstack([columns, shaken(2 * hz), shaken(3 * hz)]))[0]
        ridges = hz * span > 1.5 and left - both > LARGEST_OVERTONES * (float(self.heights @ self.heights) - left)
        if ridges or np.linalg.norm(sizes) > MOST_TURN:
            # Ridges have overtones, a vehicle on its springs has none.
            return
        height = 1e3 * np.sqrt(2.0) * float((columns @ sizes).std())
        yield (
            "sway",
            f"the vehicle rocks at {hz:.1f} Hz (or at a whole multiple of {self.rate:.0f} Hz more or less) by "
            f"±{height:.2f} mm at the surface, or that has waves of {1e3 * self.pitch * self.rate / hz:.1f} mm",
            "line",
            columns,
            1,
        )

    def fixed(self) -> Iterator[Model]:
        waves = np.column_stack([np.cos(0.5 * np.pi * k * (self.rows + 1.0)) for k in range(1, WAVES + 1)])
        words = "a pattern of the camera's rows (lens, window or sensor; clean it, then run `cell calibrate`)"
        yield "rows", words, "rows", waves * self.ray[:, None], 0
        places = self.places @ self.sides.T
        low, high = places.min(axis=0), places.max(axis=0)
        x, y = (np.pi * (places - low) / np.maximum(high - low, 1e-6)).T
        orders = [(i, j) for i, j in product(range(WAVES), repeat=2) if i + j]
        bent = np.column_stack([np.cos(i * x) * np.cos(j * y) for i, j in orders])
        yield "bent", "the surface is bent, worn or another one", "surface", bent, 0

        def disc(x: float, y: float, radius: float, power: int) -> Array:
            away = np.linalg.norm(places - (x, y), axis=1) / radius
            return np.asarray(np.maximum(0.0, 1.0 - away**power))[:, None]

        ways = [np.arange(a, b + PATCH_STEP, PATCH_STEP) for a, b in zip(low, high, strict=True)]
        key, columns, _ = self.best((key, disc(*key)) for key in product(*ways, PATCH_RADII, PATCH_SHAPES))
        inside = columns[:, 0] > 0.3
        rough = np.median(self.scatter[inside]) > ROUGHER * np.median(self.scatter[~inside])
        what = "oil, water or a reflection" if rough else "wear, a dent, or what lies (oil, dirt)"
        middle = 1e3 * np.average(self.places, axis=0, weights=columns[:, 0])
        words = f"{what} on the surface around ({middle[0]:.0f}, {middle[1]:.0f}) mm, {2e3 * key[2]:.0f} mm wide"
        yield "patch", words, "surface", columns, 3


def _ahead(cloud: Cloud) -> Array:
    """The way of the sweep, unit vectors (lines, 3), base axes."""
    sizes = np.linalg.norm(cloud.rail_spread, axis=1, keepdims=True)
    back = np.median(np.diff(cloud.rail)) < 0
    return np.asarray((-1.0 if back else 1.0) * cloud.rail_spread / np.maximum(sizes, 1e-12))
