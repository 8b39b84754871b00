"""How small a change a verification can find today: what its "good" is worth.

Noise, the arm's scatter and the calibration's own covariance hide small changes. For each part and kind of change the
smallest size is reckoned that would have exceeded the threshold in `DETECTED` of all checks like this one, whatever its
direction: the scores drawn for a good calibration are shifted by what the change adds to them.

What a change of the calibration would do to the place, in m: of the points of a scan, and of the board's place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cell.measure.calibration.drift.evidence import (
    SCAN_DEPTH,
    SHIFT,
    TARGET_DEPTH,
    TURN,
    DriftEvidence,
    Hypothesis,
    hypotheses,
    log_mean,
    quadratic,
)
from cell.measure.calibration.solve.normal import CAMERA, HAND, PLANE, RAIL, SHARED, AdjustmentState, tangents
from cell.measure.calibration.solve.results import ScanCalibration, TargetCalibration
from cell.measure.geometry.camera import Array
from cell.measure.reconstruction.build import ScanGeometry

DEPTHS = (-0.01, 0.0, 0.01)
ROWS = 9


def scan_effect(scan: ScanCalibration, change: Array, stand_off: float, rail: tuple[float, float]) -> float:
    """RMS in m of how far a change (27,) of the calibration moves the points of a sweep, in the flange's frame.

    Over the picture's rows, depths of ± 10 mm about `stand_off` m in front of the camera, and the rail from end to end.
    """
    state = AdjustmentState(
        scan.camera, scan.light_plane, scan.rail_direction, scan.flange_from_camera, scan.flange_from_camera
    )  # fmt: skip
    moved = state.moved(np.asarray(change, dtype=np.float64)[:SHARED])
    assert moved.plane is not None
    n, d = scan.light_plane.n, scan.light_plane.distance
    pixels = []
    for depth in DEPTHS:
        z = stand_off + depth
        y = np.linspace(-0.4, 0.4, ROWS) * scan.camera.height / scan.camera.fy * z
        x = (d - n[1] * y - n[2] * z) / n[0]
        pixels.append(scan.camera.project(np.column_stack([x, y, np.full(ROWS, z)])))
    seen = np.concatenate(pixels)
    after = ScanGeometry(moved.camera, moved.plane, moved.rail_direction, moved.flange_from_camera)
    squares = [
        np.sum((after.solve(seen, at)[0] - scan.geometry().solve(seen, at)[0]) ** 2, axis=1)
        for at in (np.full(len(seen), position) for position in rail)
    ]
    return float(np.sqrt(np.nanmean(squares)))


def target_effect(target: TargetCalibration, change: Array, camera_from_place: Array) -> float:
    """How far in m a change (27,) of the calibration moves a place that lies at (3,) m in the target camera's frame."""
    state = AdjustmentState(target.camera, None, np.zeros(3), target.flange_from_camera, target.flange_from_camera)
    moved = state.moved(np.asarray(change, dtype=np.float64)[:SHARED])
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
DRAWS = 2_000
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

    `step` (27,) is this change in its least visible direction, zero for an infinite size.
    """

    change: Change
    size: float
    step: Array

    @property
    def enough(self) -> bool:
        """Whether a change of the size that has to be found shows."""
        return self.size <= self.change.wanted

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
    """A size in m as mm, one in rad as degrees."""
    return 1e3 * size if unit == "m" else float(np.degrees(size))


def changes(chain: str, state: AdjustmentState) -> list[Change]:
    """Every kind of change of the "scan" or the "target" chain, for its calibrated state."""
    unit = np.eye(SHARED)
    mount, lens, *others = dict.fromkeys(h.part for h in hypotheses(chain, state.camera.fx))
    depth = SCAN_DEPTH if chain == "scan" else TARGET_DEPTH
    focal = unit[:, CAMERA][:, :4] * state.camera.fx
    made = [
        Change(chain, mount, "shift", wanted=SHIFT, unit="m", directions=unit[:, HAND][:, :3]),
        Change(chain, mount, "turn", wanted=TURN, unit="rad", directions=unit[:, HAND][:, 3:]),
        Change(chain, lens, "principal point", wanted=TURN, unit="rad", directions=focal[:, 2:]),
        Change(
            chain,
            lens,
            "focal length",
            wanted=SHIFT,
            unit="m",
            directions=(focal[:, :1] + focal[:, 1:2]) / depth,
            where=f" at {1e3 * depth:.0f} mm",
        ),
    ]
    if others:
        plane, rail = others
        length = float(np.linalg.norm(state.rail_direction))
        along = state.rail_direction / length
        across = np.column_stack(tangents(along))
        lead = unit[:, RAIL] @ along[:, None] / LEAD_WAY
        made += [
            Change(chain, plane, "turn", wanted=TURN, unit="rad", directions=unit[:, PLANE][:, :2]),
            Change(chain, plane, "shift", wanted=SHIFT, unit="m", directions=unit[:, PLANE][:, 2:]),
            Change(chain, rail, "turn", wanted=TURN, unit="rad", directions=unit[:, RAIL] @ across * length),
            Change(chain, rail, "lead", wanted=SHIFT, unit="m", directions=lead, where=f" in {1e3 * LEAD_WAY:.0f} mm"),
        ]
    return made


def detectable(
    evidences: Mapping[str, DriftEvidence],
    states: Mapping[str, AdjustmentState],
    tests: Sequence[tuple[str, Hypothesis]],
    scores: Mapping[str, Array],
    factors: Array,
    threshold: float,
) -> list[Detectable]:
    """For every kind of change of every chain.

    `scores` (n, 27) by chain are drawn for a good calibration, `factors` (n, tests) their logarithms of the Bayes
    factors of `tests`, a chain with a hypothesis each. A check is an alarm above `threshold`.
    """
    scores = {name: drawn[:DRAWS] for name, drawn in scores.items()}
    factors = factors[:DRAWS]
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
                    pulled = quadratic(weighed, h)[0] @ added[index]
                    linear[:, k], square[k] = scores[chain][:, index] @ pulled, 0.5 * added[index] @ pulled
            size = _smallest(factors, linear, square, threshold, change.wanted)
            made.append(Detectable(change, size, size * least if np.isfinite(size) else np.zeros(SHARED)))
    return made


def _smallest(factors: Array, linear: Array, square: Array, threshold: float, start: float) -> float:
    """The size x at which factors + x linear + x² square (n, k) exceed the threshold in `DETECTED` of the n draws."""

    def found(size: float) -> bool:
        exceeding = log_mean(factors + size * linear + size**2 * square) > threshold
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
