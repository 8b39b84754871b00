"""A calibration board in a picture: its points, and its pose in front of a calibrated camera.

The one way in for all kinds of boards; each refusal says why. `view.py` names boards; `chess.py`, `dots.py` and
`markers.py` find them.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pinocchio as pin

from cell.measure.geometry.board_projection import pose_equations, seen_points
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.poses import difference, from_parts, perturbed, transform
from cell.measure.vision.board.chess import find_chessboard
from cell.measure.vision.board.dots import find_dots
from cell.measure.vision.board.ends import OtherBoard
from cell.measure.vision.board.markers import find_charuco, find_tags
from cell.measure.vision.board.view import BoardSpec, BoardView
from cell.measure.vision.pictures import Image, PictureRefused, Reason, check_picture

STEPS = 30
LEAST_POINTS = 4
SETTLED = 1e-7
# The second pose that a flat board allows must fit worse by this much in χ².
CLEAR_CHI2 = 16.0
# Deviations from which a point counts less, and the median of the squared length of two Gaussian variables.
OUTLYING = 3.0
MEDIAN_SQUARE = 1.386
ROUNDS = 3
# Of points that a glint moved: times the median departure, at least so many px.
STRAY, LEAST_PX, STRAY_ROUNDS = 6.0, 0.2, 6
# Median length of two Gaussian variables.
MEDIAN_LENGTH = 1.177
# So many points tell a lens, which bends by third powers, from points that lie astray.
LENS_POINTS = 28


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Pose of a board in the camera frame.

    `covariance` (6, 6) of (translation, rotation) in camera axes, m and rad, from each point's σ, larger where the
    residuals say more; `rms_px` of all residual components; `obliquity` in rad between the board's normal and the line
    of sight to its middle.
    """

    camera_from_board: pin.SE3
    covariance: Array
    rms_px: float
    obliquity: float


def find_board(image: Image, spec: BoardSpec) -> BoardView:
    """The points of a board in an 8-bit grey image (h, w), to sub-pixel accuracy. Raises PictureRefused with the
    reason: black, saturated, no board, ambiguous order, mirrored."""
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"the board needs a grey 8-bit image, not {image.dtype} of shape {image.shape}")
    check_picture(image)
    find = {"chessboard": find_chessboard, "aprilgrid": find_tags, "charuco": find_charuco}.get(spec.kind, _find_dots)
    return without_outliers(find(image, spec))


def _find_dots(image: Image, spec: BoardSpec) -> BoardView:
    """Dark dots on a bright sheet, else bright dots on a dark one."""
    try:
        return find_dots(image, spec)
    except PictureRefused as refused:
        if refused.reason is not Reason.NO_BOARD or isinstance(refused, OtherBoard):
            raise
        try:
            return find_dots(np.asarray(255 - image, dtype=np.uint8), spec)
        except PictureRefused:
            raise refused from None


def board_pose(view: BoardView, camera: CameraModel) -> BoardPose:
    """Pose of the board of a view: robust least squares on the pixels, each point with its own σ; dots as circles.
    Raises PictureRefused when two poses explain the picture about equally well, or none does."""
    if view.size != (camera.width, camera.height):
        raise PictureRefused(
            Reason.WRONG_SIZE,
            f"the picture is {view.size[0]}×{view.size[1]} px, the camera's calibration {camera.width}×{camera.height}",
        )
    fits = sorted((_robust(view, camera, start) for start in _starts(view, camera)), key=lambda fit: fit.loss(1.0))
    if not fits:
        raise PictureRefused(Reason.AMBIGUOUS, "the board's points allow no pose; are they on one line?")
    best = fits[0]
    pose, scale = best.pose, best.scale
    covariance: Array = np.asarray(scale**2 * np.linalg.inv(best.normal), dtype=np.float64)
    if len(fits) > 1:
        apart = difference(fits[1].pose, pose)
        distinct = np.linalg.norm(apart[3:]) > 3 * np.sqrt(np.trace(covariance[3:, 3:]))
        if distinct and (fits[1].loss(scale) - best.loss(scale)) < CLEAR_CHI2:
            raise PictureRefused(
                Reason.AMBIGUOUS,
                f"two poses {np.degrees(np.linalg.norm(apart[3:])):.1f}° apart explain the picture of {view.spec.name} "
                "equally well; go nearer or look at it from another side",
            )
    normal_out = pose.rotation[:, 2]
    middle = transform(pose, view.object_points.mean(axis=0))
    cosine = float(normal_out @ middle / np.linalg.norm(middle))
    if cosine <= 0:
        raise PictureRefused(Reason.MIRRORED, f"{view.spec.name} is seen from behind: the picture is mirrored")
    return BoardPose(pose, covariance, best.rms_px, float(np.arccos(min(1.0, cosine))))


def predict(camera: CameraModel, camera_from_board: pin.SE3, points: Array, dot_radius: float) -> Array:
    """Pixels (n, 2) where board points (n, 3) are measured: ellipse centres of dots, images of corners."""
    pixels = np.empty((len(points), 2))
    rotation, translation = camera_from_board.rotation, camera_from_board.translation
    seen_points(
        camera.parameters, rotation, translation, np.ascontiguousarray(points), radius=float(dot_radius), pixels=pixels
    )
    return pixels


def _starts(view: BoardView, camera: CameraModel) -> list[pin.SE3]:
    """The one or two poses that a flat board allows in closed form. A lens that is not known yet may have no rays for
    the outermost points: the others do for a start."""
    ideal = camera.normalised(view.pixels)
    known = np.flatnonzero(np.isfinite(ideal).all(axis=1))
    if len(known) < max(LEAST_POINTS, len(ideal) / 2):
        return []
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        view.object_points[known], ideal[known].reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    return [
        from_parts(np.asarray(t, dtype=np.float64).ravel(), np.asarray(cv2.Rodrigues(r)[0], dtype=np.float64))
        for r, t in zip(turns, shifts, strict=True)
        if np.isfinite(t).all()
    ]


@dataclass(frozen=True, eq=False)
class _PoseFit:
    """A pose, the residuals (n, 2) in px and in σ, the weights (n,) and the normal matrix (6, 6) in units of σ."""

    pose: pin.SE3
    residuals: Array
    whitened: Array
    weights: Array
    normal: Array

    @property
    def rms_px(self) -> float:
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def scale(self) -> float:
        """By how much the points depart more from the pose than their σ say; at least 1. Less is not believed: an error
        that all points share shows in no residual."""
        squares = float(self.weights @ np.square(self.whitened).sum(axis=1))
        freedom = max(1.0, 2 * float(self.weights.sum()) - 6)
        return float(np.sqrt(max(1.0, squares / freedom)))

    def loss(self, scale: float) -> float:
        """χ² with points beyond `OUTLYING` deviations of `scale` counted by their logarithm."""
        lengths = np.linalg.norm(self.whitened, axis=1) / scale
        far = np.maximum(lengths / OUTLYING, 1.0)
        return float(np.sum(np.minimum(lengths, OUTLYING) ** 2 + 2 * OUTLYING**2 * np.log(far)))


def _robust(view: BoardView, camera: CameraModel, start: pin.SE3) -> _PoseFit:
    """The pose nearest to `start`; points that the others contradict, as in a glint or a shadow's edge, count less."""
    fit = _refined(view, camera, start, np.ones(len(view.ids)))
    for _ in range(ROUNDS):
        squares = np.square(fit.whitened).sum(axis=1)
        limit = OUTLYING**2 * max(1.0, float(np.median(squares)) / MEDIAN_SQUARE)
        weights = np.minimum(1.0, limit / np.maximum(squares, 1e-12))
        if np.abs(weights - fit.weights).max() < 0.01:
            break
        fit = _refined(view, camera, fit.pose, weights)
    return fit


def _refined(view: BoardView, camera: CameraModel, pose: pin.SE3, weights: Array) -> _PoseFit:
    """Levenberg's method on the pose, the points weighted by `weights` (n,) over their variances."""
    points, pixels = np.ascontiguousarray(view.object_points), np.empty(view.pixels.shape)
    lens, radius, factor = camera.parameters, float(view.dot_radius), np.sqrt(weights) / view.sigma

    def residual_of(candidate: pin.SE3) -> tuple[Array, float]:
        seen_points(lens, candidate.rotation, candidate.translation, points=points, radius=radius, pixels=pixels)
        residual = view.pixels - pixels
        white = (factor[:, None] * residual).ravel()
        total = float(white @ white)
        return residual, total if np.isfinite(total) else np.inf

    damping = 1e-6
    residual, squares = residual_of(pose)
    normal, right = np.eye(6), np.zeros(6)
    for _ in range(STEPS):
        pose_equations(
            lens, pose.rotation, pose.translation, points, factor=factor, residual=residual, normal=normal, right=right
        )
        damped = normal.copy()
        damped.flat[::7] *= 1 + damping
        candidate = perturbed(pose, np.linalg.solve(damped, right))
        new_residual, new_squares = residual_of(candidate)
        if new_squares <= squares:
            gain = squares - new_squares
            pose, residual, squares = candidate, new_residual, new_squares
            damping = max(1e-9, 0.1 * damping)
            if gain <= SETTLED * squares:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return _PoseFit(pose, residual, residual / view.sigma[:, None], weights, normal)


def without_outliers(view: BoardView) -> BoardView:
    """The view without the points that a laser line, a glint or a finger moved: the others say where they should lie. A
    flat board is seen through a homography and a smooth lens; what departs from both is dropped."""
    flat = view.object_points[:, :2] / view.spec.pitch
    terms = 10 if len(flat) >= LENS_POINTS else 6 if len(flat) >= 20 else 3
    homography, _ = cv2.findHomography(flat, view.pixels, cv2.RANSAC, 3.0)
    if homography is None or len(flat) < 12:
        return view
    mapped = np.column_stack([flat, np.ones(len(flat))]) @ np.asarray(homography, dtype=np.float64).T
    residual = view.pixels - mapped[:, :2] / mapped[:, 2:]
    x, y = ((flat - flat.mean(axis=0)) / np.ptp(flat, axis=0).max()).T
    powers = (np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3)
    design = np.column_stack(powers[:terms])
    weight = 1.0 / view.sigma
    keep = np.ones(len(flat), dtype=np.bool_)
    for _ in range(STRAY_ROUNDS):
        # Weighted: points that a laser line moved alike are many, but their edges were seen to be doubtful.
        inverse = np.linalg.pinv((weight[:, None] * design)[keep]) * weight[keep]
        # A point at the board's corner draws the fit to itself: what counts is its distance from the fit without it.
        own = np.zeros(len(flat))
        own[keep] = np.einsum("nk,kn->n", design[keep], inverse)
        away = np.linalg.norm(residual - design @ (inverse @ residual[keep]), axis=1) / np.maximum(1 - own, 0.05)
        new = away < max(LEAST_PX, STRAY * float(np.median(away[keep])))
        if new.sum() < terms + 4 or (new == keep).all():
            break
        keep = new
    sigma = view.sigma[keep]
    if view.spec.kind == "aprilgrid":
        # What is printed inside a blurred tag draws its sides alike, which their own straightness does not show.
        more = float(np.median(away[keep] / sigma)) / MEDIAN_LENGTH
        sigma = sigma * max(1.0, more)
    return replace(view, ids=view.ids[keep], pixels=view.pixels[keep], sigma=sigma)
