"""Is the light plane a plane, and is it known? Straight stripes, stripes of another line, scatter, flatness."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Self

import numpy as np
from numpy.typing import NDArray

from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.judge.checks import QualityCheck, plane_fit_check
from cell.measure.calibration.solve.adjustment import Adjustment
from cell.measure.calibration.solve.choice import Solution
from cell.measure.calibration.solve.intrinsics import Intrinsics
from cell.measure.calibration.solve.joint import Staged
from cell.measure.calibration.solve.normal import AdjustmentState
from cell.measure.calibration.solve.starts import robust_plane, stripe_pixels
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.geometry.poses import covariance_root, transform
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.board.view import BoardView
from cell.measure.vision.stripe.profile import StripeProfile
from cell.measure.vision.stripe_on_board import on_plane

CROOKED_PX, CROOKED_SHARE, CROOKED_SIGMAS = 3.0, 0.005, 8.0
"""A stripe whose centres leave a straight line by more than all of these is not one line of light on a flat board."""
ODD_SHARE, ODD_RATIO = 0.02, 6.0
"""A stripe further than this share of its distance, and than so many times the others, from the others' plane."""
LEAST_STRIPES, LEAST_CHECKED = 3, 4
THIN = 40
MOST_PAIRS = 400


def straightness(camera: CameraModel, pixels: Array, sigma: Array) -> tuple[float, float]:
    """RMS distance in px of stripe points (n, 2) from a straight line in the undistorted picture, and their own σ."""
    ideal = camera.normalised(pixels) * (camera.fx, camera.fy)
    centred = ideal - np.nanmean(ideal, axis=0)
    across = centred @ np.linalg.svd(centred, full_matrices=False)[2][1]
    return float(np.sqrt(np.mean(across**2))), float(np.sqrt(np.mean(sigma**2)))


def crooked(camera: CameraModel, pixels: Array, sigma: Array) -> str | None:
    """What is wrong with a stripe on a flat board that is not straight; None when it is."""
    off, own = straightness(camera, pixels, sigma)
    allowed = max(CROOKED_PX, CROOKED_SHARE * float(np.linalg.norm(np.ptp(pixels, axis=0))), CROOKED_SIGMAS * own)
    if off < allowed:
        return None
    return (
        f"its stripe is not straight on the board: {off:.1f} px RMS from a line, its own noise is {own:.2f} px, "
        f"allowed {allowed:.1f} px; is it one line of light, and does it lie on the board?"
    )


def odd_stripes(clouds: Sequence[Array]) -> dict[int, str]:
    """Which frames' stripe points (n, 3) in the camera frame, in m, are of another line of light than most; why. The
    plane is that of the pair of frames to which most others are nearest, so that a third of them may be wrong."""
    lit = [k for k, cloud in enumerate(clouds) if len(cloud) >= LEAST_STRIPES]
    if len(lit) < LEAST_STRIPES + 1:
        return {}
    thin = {k: clouds[k][:: max(1, len(clouds[k]) // THIN)] for k in lit}
    pairs = list(combinations(lit, 2))
    best: tuple[float, Array] | None = None
    for i, j in pairs[:: max(1, len(pairs) // MOST_PAIRS)]:
        both = np.concatenate([thin[i], thin[j]])
        spread = np.linalg.svd(both - both.mean(axis=0), compute_uv=False)
        if spread[1] < 0.02 * spread[0]:
            continue
        plane = LightPlane.fit(both)
        off = np.array([np.median(np.abs(plane.distances(thin[k]))) for k in lit])
        if best is None or np.median(off) < best[0]:
            best = float(np.median(off)), off
    if best is None:
        return {}
    usual, off = best
    near = [k for k, away in zip(lit, off, strict=True) if away < 3 * usual]
    plane = robust_plane(np.concatenate([thin[k] for k in near]))[0]
    found = {}
    for k in lit:
        away = float(np.median(np.abs(plane.distances(thin[k]))))
        reach = float(np.median(thin[k][:, 2]))
        if away > max(ODD_SHARE * reach, ODD_RATIO * usual):
            found[k] = (
                f"its stripe lies {1e3 * away:.1f} mm from the plane of the other frames' stripes, which agree to "
                f"{1e3 * usual:.1f} mm: is it another line of light, a reflection, or the stripe of another "
                "frame?"
            )
    return found


@dataclass(frozen=True)
class PlaneKnown:
    """How well a plane is known: where it was seen (m) and its normal (rad)."""

    place: float
    tilt: float

    @classmethod
    def of(
        cls, plane: LightPlane, others: Sequence[LightPlane], cloud: Array, moved: Sequence[LightPlane] = ()
    ) -> Self:
        """`others` (n) lack one frame each; `moved` are as `planes_of_cameras` gives them. `cloud` (m, 3) in m is where
        the plane was seen."""
        count = max(len(others), 1)
        thin = cloud[:: max(1, len(cloud) // 500)]

        def away(planes: Sequence[LightPlane], whole: LightPlane) -> tuple[Array, Array]:
            shifts = np.array([p.distances(thin) * _sign(p, whole) - whole.distances(thin) for p in planes])
            return shifts, np.array([p.n * _sign(p, whole) - whole.n for p in planes])

        place, tilt, share = 0.0, 0.0, (count - 1) / count
        if others:
            shift, turn = away(others, plane)
            place = share * np.mean(np.sum((shift - shift.mean(axis=0)) ** 2, axis=0))
            tilt = share * np.sum((turn - turn.mean(axis=0)) ** 2)
        if len(moved) > 1:
            shift, turn = away(moved[1:], moved[0])
            place += np.mean(np.sum(shift**2, axis=0))
            tilt += np.sum(turn**2)
        return cls(float(np.sqrt(place)), float(np.sqrt(tilt)))


def _sign(plane: LightPlane, like: LightPlane) -> float:
    return float(np.sign(plane.n @ like.n))


def planes_of_cameras(
    pictures: Intrinsics,
    views: Sequence[BoardView],
    profiles: Sequence[StripeProfile | None],
    rows: Sequence[NDArray[np.intp]],
) -> list[LightPlane]:
    """The plane with the camera off by one deviation along each direction of its covariance, one after the other."""
    lit = [
        (view, stripe_pixels(profile, chosen[:: max(1, len(chosen) // 100)]))
        for view, profile, chosen in zip(views, profiles, rows, strict=True)
        if profile is not None and len(chosen)
    ]

    def plane(off: Array | float) -> LightPlane:
        camera = pictures.camera.with_parameters(pictures.camera.parameters + off)
        clouds = [on_plane(camera, board_pose(view, camera).camera_from_board, pixels) for view, pixels in lit]
        return robust_plane(np.concatenate(clouds))[0]

    directions = covariance_root(pictures.covariance).T
    return [plane(0.0), *(plane(column) for column in directions if np.any(np.abs(column) > 0))]


def planes_without_one(clouds: Sequence[Array]) -> list[LightPlane]:
    """The plane of all clouds but one, for each cloud that has points."""
    lit = [k for k, cloud in enumerate(clouds) if len(cloud)]
    if len(lit) < LEAST_STRIPES:
        return []
    return [robust_plane(np.concatenate([clouds[j] for j in lit if j != k]))[0] for k in lit]


def plane_checks(
    rms: float, own: float, cloud: Array, frames: int, known: PlaneKnown, left_out: int = 0
) -> list[QualityCheck]:
    """Checks of a plane from its points' RMS (m), the stripe's own σ (m), the points (n, 3), and how it scatters.
    `left_out` stripes, beside those of the `frames`, are of no line in it."""
    reach = float(np.median(cloud[:, 2]))
    words = f"from {frames} frames, each left out in turn; take further frames at other distances and tilts"
    checks = [plane_fit_check(rms, own, cloud)]
    if left_out:
        checks.append(QualityCheck(
            "light_plane", "stripes that are left out", 100 * left_out / (frames + left_out), 25.0, 40.0, unit="%",
            says=f"{left_out} of {frames + left_out} lie in no plane with the others, too many for slips: was the "
            "laser or the camera moved in between, or are there several lines? Calibrate each part by itself",
        ))  # fmt: skip
    if frames < LEAST_CHECKED:
        checks.append(QualityCheck(
            "light_plane", "frames that are missing", LEAST_CHECKED - frames, doubt=0.5, refuse=np.inf, unit="",
            says=f"{frames} frames show the stripe and check each other little; take {LEAST_CHECKED} or more",
        ))  # fmt: skip
    return [
        *checks,
        QualityCheck(
            "light_plane", "σ of its place where it was seen", 100 * known.place / reach, doubt=0.5, refuse=4.0,
            unit="% of the distance", says=f"{1e3 * known.place:.2f} mm at {1e3 * reach:.0f} mm, {words}",
        ),
        QualityCheck("light_plane", "σ of its normal", float(np.degrees(known.tilt)), 1.0, 4.0, unit="deg", says=words),
    ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Flatness:
    """Distances in m of stripe points from one plane: RMS, 95th percentile, number of points, RMS per frame. `extent`
    (2,) in m along the two main directions of the points in that plane."""

    rms: float
    p95: float
    points: int
    extent: Array
    per_frame: list[float]


def flatness(state: AdjustmentState, observations: Sequence[ScanObservation], staged: Staged) -> Flatness | None:
    """Flatness of the board in the base over all frames with a stripe; None without any."""
    clouds = [_in_base(state, o, staged, k) for k, o in enumerate(observations)]
    if not any(len(cloud) for cloud in clouds):
        return None
    plane = LightPlane.fit(np.concatenate(clouds))
    return _summary(clouds, [plane.distances(cloud) for cloud in clouds])


def leave_one_out(observations: Sequence[ScanObservation], staged: Staged, solution: Solution) -> Flatness | None:
    """Each frame measured with the calibration of the others, against the plane that the others' points make."""
    lit = [k for k in range(len(observations)) if staged.plane is not None and len(staged.plane.rows[k])]
    if len(lit) < 4:
        return None
    clouds, distances = [np.zeros((0, 3))] * len(observations), [np.zeros(0)] * len(observations)
    for k in lit:
        other = solution.left.states[k]
        if solution.joint:
            # The step to it was a linear one: now to the end.
            views = [view for j, view in enumerate(solution.views) if j != k]
            other = Adjustment(views, solution.free, solution.adjusted.priors).solve(other, variance_rounds=0).state
        rest = [_in_base(other, o, staged, j) for j, o in enumerate(observations) if j != k]
        clouds[k] = _in_base(other, observations[k], staged, k)
        distances[k] = LightPlane.fit(np.concatenate(rest)).distances(clouds[k])
    return _summary(clouds, distances)


def _in_base(state: AdjustmentState, observation: ScanObservation, staged: Staged, index: int) -> Array:
    """Stripe points (n, 3) of one frame in the base, at the reported flange pose."""
    rows = None if staged.plane is None else staged.plane.rows[index]
    if state.plane is None or observation.profile is None or rows is None or not len(rows):
        return np.zeros((0, 3))
    seen = state.plane.intersect(state.camera.rays(stripe_pixels(observation.profile, rows)))
    base_from_camera = observation.base_from_flange * state.flange_from_camera
    return transform(base_from_camera, seen[np.isfinite(seen).all(axis=1)])


def _summary(clouds: Sequence[Array], distances: Sequence[Array]) -> Flatness:
    cloud, away = np.concatenate(clouds), np.concatenate(distances)
    centred = cloud - cloud.mean(axis=0)
    spread = centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T
    per_frame = [float(np.sqrt(np.mean(d**2))) if len(d) else float("nan") for d in distances]
    return Flatness(
        float(np.sqrt(np.mean(away**2))), float(np.percentile(np.abs(away), 95)), len(away), np.ptp(spread, axis=0),
        per_frame,
    )  # fmt: skip
