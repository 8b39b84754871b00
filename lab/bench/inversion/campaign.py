"""The campaign behind `cell bench inversion`: starts from near and far on every part, and scans to be refused.

A task is one part and one seed. Times are CPU times of one thread, so that a busy machine changes them little. What
small_gicp and Open3D made of the same clouds and starts is in docs/explanation/libraries.md. A scan that must not lead
to a wrong place ends within the job's tolerance or in a refusal: deformed and worn surfaces, other surfaces, disturbed
calibrations, a wrong board pose, half a scan, foreign objects. `coverage` shows that good scans' uncertainty is true.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from scipy.stats import chi2

from cell.measure.geometry.poses import difference, perturbed
from cell.measure.inversion import Prior, Tolerance, invert_pose
from cell.measure.inversion.nominal import Array, Scan
from cell.measure.inversion.registration import register
from cell.measure.reconstruction.cloud import Cloud
from drivers.errors import CellError, RefusedError
from lab.bench.inversion.scenes import (
    PARTS,
    RAIL_SIGMA,
    SETTINGS,
    STRIPE_SIGMA,
    TRUE,
    WILD,
    Setting,
    nominal,
    scan,
    start_away,
)
from lab.bench.over_cores import Done, Task, over_cores

TOLERANCE = Tolerance(0.0006, 0.006)
"""The one of the job `pot`."""
BOARD = np.diag([0.003**2] * 3 + [np.radians(0.8) ** 2] * 3)
"""The prior that the job `pot` grants the board."""
CALIBRATION = np.array([4e-5, 4e-5, 4e-5, 1e-3, 5e-4])
"""Standard deviations of the drawn calibration errors: three shifts (m), the sweep's scale, its obliquity (rad)."""

Drawn = tuple[Cloud, pin.SE3, tuple[pin.SE3, ...]]
"""A cloud, what the board says but for its noise, and the poses that are right."""
Draw = Callable[[np.random.Generator], Drawn]
_POT = PARTS["pot"].height


def _moved(cloud: Cloud, motions: Array) -> Cloud:
    return replace(cloud, points=cloud.points + motions)


def _warped(warp: Callable[[Array, Array, np.random.Generator], Array]) -> Draw:
    return lambda rng: (scan(PARTS["pot"], rng, height=lambda x, y: _POT(x, y) + warp(x, y, rng)), TRUE, (TRUE,))


def _bent(x: Array, y: Array, rng: np.random.Generator) -> Array:
    return np.asarray(rng.uniform(0.0003, 0.003) * rng.choice([-1, 1]) * (x / 0.035) ** 2)


def _twisted(x: Array, y: Array, rng: np.random.Generator) -> Array:
    return np.asarray(rng.uniform(0.0003, 0.002) * x * y / (0.035 * 0.018))


def _worn(x: Array, y: Array, rng: np.random.Generator) -> Array:
    return np.asarray(-rng.uniform(0.0003, 0.002) * (x > rng.uniform(-0.02, 0.02)) * np.clip(x + 0.02, 0, 1) / 0.05)


def _sunk(setting: Setting) -> Draw:
    """One side has sunk as a whole, a fracture: the pose of either side is a right one."""

    def draw(rng: np.random.Generator) -> Drawn:
        depth, edge = rng.uniform(0.0007, 0.004), rng.uniform(-0.01, 0.01)
        broken = scan(PARTS["pot"], rng, setting, height=lambda x, y: _POT(x, y) - depth * (x + 0.5 * y > edge))
        return broken, TRUE, (TRUE, TRUE * pin.SE3(np.eye(3), np.array([0.0, 0.0, -depth])))

    return draw


def _other(name: str) -> Draw:
    return lambda rng: (scan(PARTS["pot"], rng, height=PARTS[name].height), TRUE, (TRUE,))


def _flipped(sx: int, sy: int) -> Draw:
    return lambda rng: (scan(PARTS["pot"], rng, height=lambda x, y: _POT(sx * x, sy * y)), TRUE, (TRUE,))


def _scaled(rng: np.random.Generator) -> Drawn:
    k = 1 + rng.uniform(0.01, 0.06) * rng.choice([-1, 1])
    return scan(PARTS["pot"], rng, height=lambda x, y: _POT(x * k, y * k)), TRUE, (TRUE,)


def _disturbed(rng: np.random.Generator) -> Drawn:
    """0.3 mm and 0.1° somewhere in the chain: the cloud is moved, and sheared and bent a little."""
    cloud = scan(PARTS["pot"], rng)
    way, axis = rng.normal(size=3), rng.normal(size=3)
    arm = cloud.points - TRUE.translation
    move = 0.0003 * way / np.linalg.norm(way) + np.cross(np.radians(0.1) * axis / np.linalg.norm(axis), arm)
    bend = rng.normal(size=3) * 0.3 * (arm[:, :, 1:2] ** 2)
    return _moved(cloud, move + bend), TRUE, (TRUE,)


def _board_wrong(rng: np.random.Generator) -> Drawn:
    way = rng.normal(size=3)
    board = perturbed(TRUE, np.append(0.010 * way / np.linalg.norm(way), np.zeros(3)))
    return scan(PARTS["pot"], rng), board, (TRUE,)


def _of_setting(setting: Setting) -> Draw:
    return lambda rng: (scan(PARTS["pot"], rng, setting), TRUE, (TRUE,))


CASES: dict[str, Draw] = {
    "bent 0.3 to 3 mm": _warped(_bent),
    "twisted 0.3 to 2 mm": _warped(_twisted),
    "worn 0.3 to 2 mm on one side": _warped(_worn),
    "one side sunk 0.7 to 4 mm": _sunk(Setting()),
    "sunk, 40 % of it missing": _sunk(Setting(missing=0.4)),
    "another part: seat": _other("seat"),
    "another part: plate": _other("plate"),
    "mirrored": _flipped(-1, 1),
    "turned by 180°": _flipped(-1, -1),
    "1 to 6 % too large or small": _scaled,
    "calibration disturbed, 0.3 mm and 0.1°": _disturbed,
    "board wrong by 10 mm": _board_wrong,
    "half of the scan": _of_setting(Setting(missing=0.5)),
    "70 % missing": _of_setting(Setting(missing=0.7)),
    "40 % clutter": _of_setting(Setting(clutter=0.4)),
    "60 % clutter": _of_setting(Setting(clutter=0.6)),
}


@dataclass(frozen=True)
class Judged:
    """How a case ended: "within" the tolerance, "refused" for `reason`, or "outside" it by `error` (m, rad)."""

    case: str
    ended: str
    error: tuple[float, float] | None
    reason: str


def judge_case(case: str, seed: int) -> Judged:
    """Draw the case and the board's own error from `seed`, invert, and compare with the job's tolerance."""
    rng = np.random.default_rng(seed)
    cloud, expected, rights = CASES[case](rng)
    board = perturbed(expected, 0.5 * rng.normal(size=6) * np.sqrt(np.diag(BOARD)))
    try:
        pose = invert_pose(cloud, nominal("pot"), Prior(board, BOARD), TOLERANCE)
    except CellError as error:
        return Judged(case, "refused", None, str(error))
    off = min(PARTS["pot"].error(pose.base_from_surface, right) for right in rights)
    good = off[0] <= TOLERANCE.translation and off[1] <= TOLERANCE.rotation
    return Judged(case, "within" if good else "outside", off, "")


def coverage(seed: int) -> tuple[Array, float]:
    """Normalised error (6,) and squared Mahalanobis distance of a good scan, board and calibration errors drawn."""
    rng = np.random.default_rng([seed, 1])
    part = ("pot", "seat")[seed % 2]
    cloud = scan(PARTS[part], rng, Setting(missing=0.2 * (seed % 3)))
    arm = cloud.points - TRUE.translation
    ways = np.zeros((*cloud.points.shape, 5))
    ways[..., 0, 0] = ways[..., 1, 1] = ways[..., 2, 2] = 1.0
    ways[..., 0, 3] = ways[..., 1, 4] = arm[:, :, 0]
    ways *= CALIBRATION
    moved = _moved(cloud, ways @ rng.normal(size=5))
    prior = Prior(perturbed(TRUE, rng.normal(size=6) * np.sqrt(np.diag(BOARD))), BOARD)
    pose = invert_pose(moved, nominal(part), prior, TOLERANCE, calibration=lambda lines, rows: ways[lines, rows])
    error = difference(pose.base_from_surface, TRUE)
    return error / pose.sigma, float(error @ np.linalg.solve(pose.covariance, error))


STARTS = {"far": (0.008, 20.0), "near": (0.003, 0.8)}
"""Where the search begins: m and degrees from the true pose; the prior's standard deviations are the same."""
CONVERGED = (0.0002, 0.004)
"""A pose this near to the true one, m and rad, is found: no noise reaches so far, and no local minimum lies so near."""


@dataclass(frozen=True)
class Outcome:
    """One registration: `error` in m and rad of what the part determines (infinite if it gave up), CPU time in s."""

    part: str
    seed: int
    setting: str
    start: str
    error: tuple[float, float]
    seconds: float

    @property
    def converged(self) -> bool:
        """True when the pose is the true one."""
        return self.error[0] < CONVERGED[0] and self.error[1] < CONVERGED[1]


def prior(kind: str, rng: np.random.Generator) -> Prior:
    """A start of the `kind` in a random direction, as uncertain as it is wrong."""
    metres, degrees = STARTS[kind]
    spread = np.diag([metres**2] * 3 + [np.radians(degrees) ** 2] * 3)
    return Prior(start_away(rng, metres, degrees), spread)


def task(part: str, seed: int) -> list[Outcome]:
    """Both starts on one part; the setting goes round with the seed."""
    label = list(SETTINGS)[seed % len(SETTINGS)]
    rng = np.random.default_rng(seed)
    cloud = Scan.of(scan(PARTS[part], rng, SETTINGS[label]))
    outcomes = []
    for kind in STARTS:
        begin = prior(kind, rng)
        started = time.process_time()
        try:
            error = PARTS[part].error(register(cloud, nominal(part), begin).base_from_surface, TRUE)
        except RefusedError:
            error = (float("inf"), float("inf"))
        outcomes.append(Outcome(part, seed, label, kind, error, time.process_time() - started))
    return outcomes


def table(outcomes: Iterable[Outcome]) -> list[dict[str, object]]:
    """One row for each part and start, and for all parts together."""
    groups: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        for part in (PARTS[outcome.part].title, "all parts"):
            groups[part, outcome.start].append(outcome)
    ordered = sorted(groups.items(), key=lambda item: item[0][0] == "all parts")
    return [{"part": part, "start": start, **_figures(group)} for (part, start), group in ordered]


def _figures(group: list[Outcome]) -> dict[str, object]:
    """Share converged (%), errors of those (mm, mrad) and the median time (ms)."""
    found = 1e3 * np.array([o.error for o in group if o.converged]).reshape(-1, 2)
    row: dict[str, object] = {"starts": len(group), "converged_percent": _percent(group)}
    for column, unit in enumerate(("mm", "mrad")):
        for name, share in (("median", 50), ("p95", 95)):
            row[f"{name}_{unit}"] = round(float(np.percentile(found[:, column], share)), 4) if len(found) else None
    row["ms"] = round(1e3 * float(np.median([o.seconds for o in group])), 1)
    settings = {label: [o for o in group if o.setting == label] for label in SETTINGS}
    return row | {"converged_percent_by_setting": {k: _percent(some) for k, some in settings.items() if some}}


def _percent(group: list[Outcome]) -> float:
    return round(100 * sum(o.converged for o in group) / len(group), 1)


def campaign(starts: int, cases: int, done: Done) -> dict[str, object]:
    """Rows of `registration`, of `refusals` and the figures of `coverage`."""
    tasks: list[Task] = [(task, part, seed) for seed in range(starts) for part in PARTS]
    tasks += [(judge_case, case, seed) for case in CASES for seed in range(cases)]
    tasks += [(coverage, seed) for seed in range(5 * cases)]
    found = over_cores(tasks, ended=lambda made: done(""))
    outcomes = [outcome for made in found if isinstance(made, list) for outcome in made]
    judged = [made for made in found if isinstance(made, Judged)]
    order = {part: k for k, part in enumerate(PARTS)}
    outcomes.sort(key=lambda outcome: (order[outcome.part], outcome.start, outcome.seed))
    return {
        "registration": table(outcomes),
        "refusals": [_case_row(case, [j for j in judged if j.case == case]) for case in CASES],
        "coverage": _coverage([made for made in found if isinstance(made, tuple)]),
        "assumed_noise": {
            "stripe_mm": 1e3 * STRIPE_SIGMA,
            "rail_mm": 1e3 * RAIL_SIGMA,
            "wild_points_percent": 100 * WILD,
        },
    }


def _case_row(case: str, judged: list[Judged]) -> dict[str, object]:
    ended = Counter(j.ended for j in judged)
    errors = [j.error for j in judged if j.error is not None]
    reasons = sorted(j.reason for j in judged if j.reason)
    return {
        "case": case,
        **{end: ended[end] for end in ("within", "refused", "outside")},
        "worst_mm": round(1e3 * max(e[0] for e in errors), 3) if errors else None,
        "worst_mrad": round(1e3 * max(e[1] for e in errors), 2) if errors else None,
        "reason": reasons[0] if reasons else None,
    }


def _coverage(scores: list[tuple[Array, float]]) -> dict[str, object]:
    z = np.array([score for score, _ in scores])
    held = np.mean([distance < chi2.ppf(0.95, 6) for _, distance in scores])
    return {
        "scans": len(scores),
        "ellipsoid_95_percent": round(100 * float(held), 1),
        "z_score_rms": [round(float(v), 3) for v in np.sqrt(np.mean(z**2, axis=0))],
    }
