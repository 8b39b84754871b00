"""The board campaign: random views under each condition, what the detection says of them, and how far it is off.

Counts what was found, refused and wrong, compares points and poses with the truth, and holds the stated covariance to
the errors: z is the RMS of the whitened pose errors, z_axes each component's over its own σ (x, y, z, then the
rotations about them, in the camera), coverage the share of errors inside the stated 95 % ellipsoid. OpenCV's own
detectors look at the same pictures; they have to find all of the board, but for ChArUco.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import pinocchio as pin
from scipy.stats import chi2

from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.poses import difference
from cell.measure.vision.board.board import board_pose, find_board
from cell.measure.vision.board.view import KINDS, Kind
from cell.measure.vision.pictures import PictureRefused
from lab.bench.board.conditions import CONDITIONS, Condition, View, draw_view
from lab.bench.board.render import Lens

# A point farther than this share of a pitch from its own place bears another's name.
STRAY = 0.25


@dataclass
class Tally:
    """What a condition gave: counts, errors of points in px, of poses in m and rad, these over their σ, times."""

    views: int = 0
    found: int = 0
    refused: int = 0
    wrong: int = 0
    points: list[float] = field(default_factory=list)
    places: list[float] = field(default_factory=list)
    turns: list[float] = field(default_factory=list)
    whitened: list[float] = field(default_factory=list)
    scores: list[Array] = field(default_factory=list)
    found_s: list[float] = field(default_factory=list)
    refused_s: list[float] = field(default_factory=list)
    peer_found: list[bool] = field(default_factory=list)
    peer_s: list[float] = field(default_factory=list)
    reasons: dict[str, int] = field(default_factory=dict)

    def row(self) -> dict[str, Any]:
        """The condition's line of the report; None where there is nothing to say."""
        squares = np.array(self.whitened)

        def rms(values: list[float], factor: float) -> float | None:
            return round(factor * float(np.sqrt(np.mean(np.square(values)))), 4) if values else None

        def middle(values: list[float]) -> float | None:
            return round(1e3 * float(np.median(values)), 1) if values else None

        return {
            "views": self.views, "found": round(self.found / max(self.views, 1), 4),
            "refused": round(self.refused / max(self.views, 1), 4), "wrong": self.wrong,
            "centre_rms_px": rms(self.points, 1.0), "pose_mm": rms(self.places, 1e3), "pose_mrad": rms(self.turns, 1e3),
            "z": round(float(np.sqrt(squares.mean() / 6)), 3) if len(squares) else None,
            "z_axes": np.sqrt(np.mean(np.square(self.scores), axis=0)).round(3).tolist() if self.scores else None,
            "coverage_95": round(float((squares < chi2.ppf(0.95, 6)).mean()), 3) if len(squares) else None,
            "found_ms": middle(self.found_s), "refused_ms": middle(self.refused_s),
            "opencv_found": round(float(np.mean(self.peer_found)), 4) if self.peer_found else None,
            "opencv_ms": middle(self.peer_s),
            "slowest_ms": round(1e3 * max([*self.found_s, *self.refused_s], default=0.0), 1),
            "reasons": dict(sorted(self.reasons.items())),
        }  # fmt: skip

    def __iadd__(self, other: "Tally") -> "Tally":
        for name, value in vars(other).items():
            if isinstance(value, dict):
                for key, count in value.items():
                    self.reasons[key] = self.reasons.get(key, 0) + count
            else:
                setattr(self, name, getattr(self, name) + value)
        return self


def camera_of(lens: Lens) -> CameraModel:
    """The calibrated camera that sees as the lens does."""
    return CameraModel(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, lens.distortion)


def applies(condition: Condition, kind: Kind) -> bool:
    """Only marked and ChArUco boards differ from their mirror images: the others have a line of symmetry."""
    return "mirrored" not in condition.changes or kind in ("marked_dots", "charuco")


def by_opencv(view: View) -> bool | None:
    """Whether OpenCV's own detector finds the named board in a view; None where it has none for its kind."""
    spec, picture = view.spec, view.picture
    if spec.kind == "chessboard":
        return bool(cv2.findChessboardCornersSB(picture, spec.grid)[0])
    if spec.kind in ("dots", "asymmetric_dots"):
        symmetry = cv2.CALIB_CB_SYMMETRIC_GRID if spec.kind == "dots" else cv2.CALIB_CB_ASYMMETRIC_GRID
        return bool(cv2.findCirclesGrid(picture, (spec.cols, spec.rows), flags=symmetry)[0])
    if spec.kind == "charuco":
        printed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
        board = cv2.aruco.CharucoBoard((spec.cols, spec.rows), spec.pitch, spec.marker, printed)
        return cv2.aruco.CharucoDetector(board).detectBoard(picture)[1] is not None
    return None


def judge(view: View, expect: str, tally: Tally) -> None:
    """Look for the named board in a view and add the outcome to the tally."""
    tally.views += 1
    start = time.perf_counter()
    if expect == "found" and (found := by_opencv(view)) is not None:
        tally.peer_found.append(found)
        tally.peer_s += [time.perf_counter() - start] if found else []
    start = time.perf_counter()
    try:
        seen = find_board(view.picture, view.spec)
        tally.found_s.append(time.perf_counter() - start)
        if expect == "refused":
            tally.wrong += 1
            return
        pose = board_pose(seen, camera_of(view.lens))
    except PictureRefused as refused:
        tally.refused_s.append(time.perf_counter() - start)
        tally.refused += 1
        tally.reasons[refused.reason] = tally.reasons.get(refused.reason, 0) + 1
        return
    truth = pin.SE3(view.placed.pose)
    matches = [(float(np.linalg.norm(t.pixels - view.pixels[t.ids], axis=1).max()), t) for t in seen.turns()]
    worst, named = min(matches, key=lambda m: m[0])
    if worst > STRAY * _pitch_px(view):
        tally.wrong += 1
        return
    if seen.order_assumed:
        pose = board_pose(named, camera_of(view.lens))
    tally.found += 1
    tally.points += np.square(named.pixels - view.pixels[named.ids]).mean(axis=1).tolist()
    tally.points[-len(named.ids) :] = np.sqrt(tally.points[-len(named.ids) :]).tolist()
    error = difference(pose.camera_from_board, truth)
    tally.places.append(float(np.linalg.norm(error[:3])))
    tally.turns.append(float(np.linalg.norm(error[3:])))
    tally.scores.append(error / np.sqrt(np.diag(pose.covariance)))
    tally.whitened.append(float(error @ np.linalg.solve(pose.covariance, error)))


def _pitch_px(view: View) -> float:
    apart = np.linalg.norm(view.pixels[:, None] - view.pixels[None], axis=2)
    return float(apart[apart > 0].min())


def campaign(
    views: int, seed: int, kinds: Sequence[Kind] = KINDS, conditions: Sequence[Condition] = CONDITIONS,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:  # fmt: skip
    """The report over `views` random views for each kind and condition; the same seed gives the same pictures."""
    rows, by_kind = [], {kind: Tally() for kind in kinds}
    for number, condition in enumerate(conditions):
        whole = Tally()
        for kind in kinds:
            own = Tally()
            for k in range(views if applies(condition, kind) else 0):
                rng = np.random.default_rng((seed, number, KINDS.index(kind), k))
                judge(draw_view(condition, kind, rng), condition.expect, own)
                progress(f"{condition.name}, {kind}")
            whole += own
            if condition.expect == "found":
                by_kind[kind] += own
            rows.append({"condition": condition.name, "expect": condition.expect, "kind": kind, **own.row()})
        rows.append({"condition": condition.name, "expect": condition.expect, "kind": "all", **whole.row()})
    return {
        "views_per_line": views,
        "seed": seed,
        "assumed_noise": {"electrons_per_dn": 40, "read_noise_dn": 0.4, "pictures": "simulated by ray casting"},
        "wrong": sum(int(row["wrong"]) for row in rows if row["kind"] == "all"),
        "kinds": {kind: tally.row() for kind, tally in by_kind.items()},
        "rows": rows,
    }
