"""How good is a stored calibration today? One decision from a view of each deck board and a sweep over the fine one.

Every part of the chain that may have changed is a hypothesis against none
(`cell.measure.calibration.drift.evidence`). Their mean Bayes factor is the statistic; what it exceeds by chance is
found by drawing scores from their own covariance, so that a good calibration is called disturbed in `FALSE_ALARMS` of
all checks. The most probable part is named. `detectable` says what a good verdict is worth: noise, the arm's scatter
and the calibration's own covariance hide small changes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.measure.calibration.drift import evidence
from cell.measure.calibration.drift.evidence import DriftEvidence, Hypothesis
from cell.measure.calibration.solve.normal import BOARD, CAMERA, HAND, PLANE, RAIL, SHARED, AdjustmentState, tangents
from cell.measure.calibration.solve.results import PARAMETERS, ScanCalibration, TargetCalibration
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import covariance_root
from cell.measure.reconstruction.build import ScanGeometry

FALSE_ALARMS = 0.03
WORST_FIT = 1.6
"""Residuals larger than this many times the calibration's own have another cause than a moved part."""
DRAWS = 8_000
LEAST_PROBABILITY = 0.1
LENS = PARAMETERS[:9]


@dataclass(frozen=True, eq=False)
class Suspect:
    """A part that may have changed: how probable among the parts, and the most probable change (27,) of the chain.
    `spread` (27, k) is a root of the change's covariance. Of another `round`: changed as well, not instead."""

    chain: str
    part: str
    probability: float
    change: Array
    spread: Array
    round: int = 0

    def as_dict(self) -> dict[str, object]:
        """For reports, units in the names."""
        return {"part": self.part, "probability": round(self.probability, 3), "change": _named(self.change)}


@dataclass(frozen=True)
class Figure:
    """One compared quantity with one standard deviation of what a good calibration gives."""

    name: str
    value: float
    sigma: float
    unit: str

    def as_dict(self) -> dict[str, object]:
        """For reports."""
        return {"name": self.name, "value": round(self.value, 5), "sigma": round(self.sigma, 5), "unit": self.unit}


@dataclass(frozen=True, eq=False)
class DriftVerdict:
    """`statistic` is the logarithm of the mean Bayes factor for a change, `threshold` what chance reaches.

    `fit` holds RMS residuals over the calibration's own by kind; `suspects` come most probable first;
    `detectable` says how large a change of each part had to be to be found today.
    """

    statistic: float
    threshold: float
    fit: dict[str, float]
    suspects: list[Suspect]
    figures: list[Figure]
    detectable: "list[Detectable]"

    @property
    def badly_fitting(self) -> list[str]:
        """Kinds of measurement that fit no change of the calibrated parts."""
        return [kind for kind, value in self.fit.items() if value > WORST_FIT]

    @property
    def changed(self) -> bool:
        """True when a change of some part shows."""
        return self.statistic > self.threshold

    @property
    def good(self) -> bool:
        """True when nothing speaks for a change."""
        return not self.changed and not self.badly_fitting


def verdict(evidences: Mapping[str, DriftEvidence], states: Mapping[str, AdjustmentState]) -> DriftVerdict:
    """Decide, by chain ("scan", "target"), from the evidence and the calibrated states that it was weighed against."""
    tests = [(name, h) for name in evidences for h in evidence.hypotheses(name, states[name].camera.fx)]
    found = np.array([evidence.log_factor(evidences[name], h, evidences[name].score[None])[0] for name, h in tests])
    rng = np.random.default_rng(0)
    scores = {}
    for name, weighed in evidences.items():
        root = covariance_root(weighed.information)
        scores[name] = rng.normal(size=(DRAWS, root.shape[1])) @ root.T
    drawn = np.stack([evidence.log_factor(evidences[name], h, scores[name]) for name, h in tests], axis=1)
    threshold = float(np.quantile(evidence.log_mean(drawn), 1 - FALSE_ALARMS))
    fit = {}
    for name, weighed in evidences.items():
        fit[f"{name} dots"] = weighed.dots
        if np.isfinite(weighed.stripe):
            fit["stripe"] = weighed.stripe
    figures = [figure for name in evidences for figure in _figures(name, evidences[name], states[name])]
    seen = detectable(evidences, states, tests, scores=scores, factors=drawn, threshold=threshold)
    return DriftVerdict(
        float(evidence.log_mean(found[None])[0]), threshold, fit, _all_suspects(evidences, tests, threshold), figures,
        detectable=seen,
    )  # fmt: skip


def _all_suspects(
    evidences: Mapping[str, DriftEvidence], tests: list[tuple[str, Hypothesis]], threshold: float
) -> list[Suspect]:
    """The suspects, and further ones for what the most probable change leaves unexplained beyond chance. Parts that
    changed together are not rivals: one that does nothing to the place must not hide one that does."""
    made, left = list[Suspect](), dict(evidences)
    while True:
        found = np.array([evidence.log_factor(left[name], h, left[name].score[None])[0] for name, h in tests])
        if made and not float(evidence.log_mean(found[None])[0]) > threshold:
            return made
        rounds = made[-1].round + 1 if made else 0
        named = {(s.chain, s.part) for s in made}
        more = [s for s in _suspects(left, tests, found) if (s.chain, s.part) not in named]
        if not more:
            return made
        made += [replace(suspect, round=rounds) for suspect in more]
        weighed = left[more[0].chain]
        left[more[0].chain] = replace(weighed, score=weighed.score - weighed.information @ more[0].change)


def _suspects(
    evidences: Mapping[str, DriftEvidence], tests: list[tuple[str, Hypothesis]], found: Array
) -> list[Suspect]:
    """Parts by probability, where each hypothesis is as probable as any other beforehand."""
    weight = np.exp(found - found.max())
    weight /= weight.sum()
    parts: dict[tuple[str, str], list[int]] = {}
    for k, (chain, h) in enumerate(tests):
        parts.setdefault((chain, h.part), []).append(k)
    made = []
    for (chain, part), members in parts.items():
        _, h = tests[max(members, key=lambda k: weight[k])]
        index, weighed = list(h.index), evidences[chain]
        change = np.zeros(SHARED)
        held = weighed.information[np.ix_(index, index)] + np.diag(1 / np.array(h.size) ** 2)
        change[index] = np.linalg.solve(held, weighed.score[index])
        spread = np.zeros((SHARED, len(index)))
        spread[index] = np.linalg.cholesky(np.linalg.inv(held))
        made.append(Suspect(chain, part, float(weight[members].sum()), change, spread))
    made.sort(key=lambda suspect: -suspect.probability)
    return [s for k, s in enumerate(made) if k == 0 or s.probability >= LEAST_PROBABILITY]


def _figures(name: str, weighed: DriftEvidence, state: AdjustmentState) -> list[Figure]:
    """The board against where the calibration found it, and for the scan head light plane and rail, each by itself."""
    board = np.eye(SHARED)[:, BOARD]
    moved, covariance = weighed.change(board)
    sigma = np.sqrt(np.diag(covariance))
    made = [
        Figure(f"{name} board, {axis} in the base", 1e3 * float(value), 1e3 * float(s), unit)
        for axis, unit, value, s in zip(
            ("x", "y", "z", "about x", "about y", "about z"), ("mm",) * 3 + ("mrad",) * 3, moved, sigma, strict=True
        )
    ]
    if state.plane is not None:
        quantities = (
            ("stripe against the photographed board", [PLANE.stop - 1], 1e3, "mm"),
            ("rail's scale", [RAIL.start], 1e3, "per mille"),
        )
        for text, index, factor, unit in quantities:
            change, spread = weighed.change(np.hstack([board, np.eye(SHARED)[:, index]]))
            made.append(Figure(text, factor * float(change[-1]), factor * float(np.sqrt(spread[-1, -1])), unit))
    return made


def _named(change: Array) -> dict[str, float]:
    """The parameters that change with their units: the lens' in px or none, m as mm, rad as mrad."""
    return {
        name.replace(" ", "_") + _unit(name): round(float(change[k]) * (1.0 if name in LENS else 1e3), 4)
        for k, name in enumerate(PARAMETERS)
        if change[k] != 0.0
    }


def _unit(name: str) -> str:
    if name in LENS:
        return "_px" if name[0] in "fc" else ""
    if name.startswith("rail"):
        return "_per_mille"
    return "_mrad" if "tilt" in name or name.split()[-1] in ("rx", "ry", "rz") else "_mm"


DEPTHS = (-0.01, 0.0, 0.01)
ROWS = 9


def scan_effect(scan: ScanCalibration, stand_off: float, rail: tuple[float, float]) -> Callable[[Array], float]:
    """Gives of a change (27,) of the calibration the RMS in m of how far it moves a sweep's points, flange frame. Over
    the picture's rows, depths of ± 10 mm about `stand_off` m in front of the camera, and the rail from end to end."""
    n, d = scan.light_plane.n, scan.light_plane.distance
    pixels = []
    for depth in DEPTHS:
        z = stand_off + depth
        y = np.linspace(-0.4, 0.4, ROWS) * scan.camera.height / scan.camera.fy * z
        x = (d - n[1] * y - n[2] * z) / n[0]
        pixels.append(scan.camera.project(np.column_stack([x, y, np.full(ROWS, z)])))
    seen, at = np.tile(np.concatenate(pixels), (len(rail), 1)), np.repeat(rail, len(DEPTHS) * ROWS)
    before = scan.geometry().solve(seen, at)[0]
    state = scan.state(scan.flange_from_camera)

    def effect(change: Array) -> float:
        moved = state.moved(np.asarray(change, dtype=np.float64)[:SHARED])
        assert moved.plane is not None
        after = ScanGeometry(moved.camera, moved.plane, moved.rail_direction, moved.flange_from_camera)
        return float(np.sqrt(np.nanmean(np.sum((after.solve(seen, at)[0] - before) ** 2, axis=1))))

    return effect


def target_effect(target: TargetCalibration, change: Array, camera_from_place: Array) -> float:
    """How far in m a change (27,) of the calibration moves a place that lies at (3,) m in the target camera's frame."""
    moved = target.state(target.flange_from_camera).moved(np.asarray(change, dtype=np.float64)[:SHARED])
    before, after = target.camera, moved.camera
    # The same picture through the other lens: a shift of the principal point turns the rays, a focal length stretches
    # the distance.
    seen = np.array(camera_from_place, dtype=np.float64)
    turned = seen + seen[2] * np.array([
        -(after.cx - before.cx) / before.fx, -(after.cy - before.cy) / before.fy, 0.5 * (
            (after.fx - before.fx) / before.fx + (after.fy - before.fy) / before.fy
        ),
    ])  # fmt: skip
    was = target.flange_from_camera.act(seen)
    return float(np.linalg.norm(moved.flange_from_camera.act(turned) - was))


DETECTED = 0.95
DETECTION_DRAWS = 2_000
DOUBLINGS, HALVINGS = 40, 10
LEAD_WAY = 0.1
"""The way, in m, over which an error of the rail's lead is stated."""


@dataclass(frozen=True, eq=False)
class Change:
    """A kind of change of one part: the columns (27, k) of `directions` change it by 1 m or 1 rad each.

    `wanted` is the size in `unit`, "m" or "rad", that has to be found. `where` says of a size in m what it is the
    effect of: a focal length's shift of the depth at some distance, a lead's after some way.
    """

    chain: str
    part: str
    kind: str
    wanted: float
    unit: str
    directions: Array
    where: str = ""


@dataclass(frozen=True, eq=False)
class Detectable:
    """The smallest `size` (m or rad, as its kind of change; infinite where nothing shows) that is found in `DETECTED`.
    `step` (27,) is this change in its least visible direction, zero for an infinite size."""

    change: Change
    size: float
    step: Array

    @property
    def words(self) -> str:
        """How large a change may be that does not show."""
        if not np.isfinite(self.size):
            return "of any size"
        shown = f"{_shown(self.size, self.change.unit):.3f}"
        return f"up to {shown} mm{self.change.where}" if self.change.unit == "m" else f"up to {shown}°"

    def as_dict(self) -> dict[str, object]:
        """For reports, sizes in mm or degrees; None for one that is infinite."""
        return {
            "part": self.change.part,
            "change": self.change.kind,
            "size": round(_shown(self.size, self.change.unit), 4) if np.isfinite(self.size) else None,
            "wanted": round(_shown(self.change.wanted, self.change.unit), 4),
            "unit": _UNITS[self.change.unit] + self.change.where,
        }


_UNITS = {"m": "mm", "rad": "deg"}


def _shown(size: float, unit: str) -> float:
    return 1e3 * size if unit == "m" else float(np.degrees(size))


def changes(chain: str, state: AdjustmentState) -> list[Change]:
    """Every kind of change of the "scan" or the "target" chain, for its calibrated state."""
    unit = np.eye(SHARED)
    mount, lens, *others = dict.fromkeys(h.part for h in evidence.hypotheses(chain, state.camera.fx))
    depth = evidence.SCAN_DEPTH if chain == "scan" else evidence.TARGET_DEPTH
    focal = unit[:, CAMERA][:, :4] * state.camera.fx
    kinds = [
        (mount, "shift", unit[:, HAND][:, :3], ""),
        (mount, "turn", unit[:, HAND][:, 3:], ""),
        (lens, "principal point", focal[:, 2:], ""),
        (lens, "focal length", (focal[:, :1] + focal[:, 1:2]) / depth, f" at {1e3 * depth:.0f} mm"),
    ]
    if others:
        plane, rail = others
        length = float(np.linalg.norm(state.rail_direction))
        along = state.rail_direction / length
        across = np.column_stack(tangents(along))
        kinds += [
            (plane, "turn", unit[:, PLANE][:, :2], ""),
            (plane, "shift", unit[:, PLANE][:, 2:], ""),
            (rail, "turn", unit[:, RAIL] @ across * length, ""),
            (rail, "lead", unit[:, RAIL] @ along[:, None] / LEAD_WAY, f" in {1e3 * LEAD_WAY:.0f} mm"),
        ]
    sizes = {"turn": (evidence.TURN, "rad"), "principal point": (evidence.TURN, "rad")}
    return [
        Change(chain, part, kind, *sizes.get(kind, (evidence.SHIFT, "m")), directions, where)
        for part, kind, directions, where in kinds
    ]


def detectable(
    evidences: Mapping[str, DriftEvidence], states: Mapping[str, AdjustmentState],
    tests: Sequence[tuple[str, Hypothesis]], scores: Mapping[str, Array], factors: Array, threshold: float,
) -> list[Detectable]:  # fmt: skip
    """For every kind of change of every chain.

    `scores` (n, 27) by chain are drawn for a good calibration, `factors` (n, tests) their logarithms of the Bayes
    factors of `tests`, a chain with a hypothesis each. A check is an alarm above `threshold`.
    """
    scores = {name: drawn[:DETECTION_DRAWS] for name, drawn in scores.items()}
    factors = factors[:DETECTION_DRAWS]
    made = []
    for chain, weighed in evidences.items():
        for change in changes(chain, states[chain]):
            d = change.directions
            least = d @ np.linalg.eigh(d.T @ weighed.information @ d)[1][:, 0]
            linear, square = np.zeros_like(factors), np.zeros(len(tests))
            added = weighed.information @ least
            for k, (name, h) in enumerate(tests):
                if name == chain:
                    index = list(h.index)
                    pulled = evidence.quadratic(weighed, h)[0] @ added[index]
                    linear[:, k], square[k] = scores[chain][:, index] @ pulled, 0.5 * added[index] @ pulled
            size = _smallest(factors, linear, square, threshold, change.wanted)
            made.append(Detectable(change, size, size * least if np.isfinite(size) else np.zeros(SHARED)))
    return made


def _smallest(factors: Array, linear: Array, square: Array, threshold: float, start: float) -> float:
    """The size x at which factors + x linear + x² square (n, k) exceed the threshold in `DETECTED` of the n draws."""

    def found(size: float) -> bool:
        exceeding = evidence.log_mean(factors + size * linear + size**2 * square) > threshold
        return float(np.mean(exceeding)) >= DETECTED

    high = start / 16
    for _ in range(DOUBLINGS):
        if found(high):
            break
        high *= 2
    else:
        return float("inf")
    low = high / 2
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if found(middle) else (middle, high)
    return high
