"""What new observations say about a stored calibration: score and information of every parameter, and hypotheses.

What the arm's repeatability, the rail's reading, the noise and the calibration's own covariance explain of the misfit
is taken out; what is left speaks for a change. A hypothesis is a Gaussian change of about `SHIFT` or `TURN` of some
parameters of one camera's chain, against none. A calibration leaves a `Reference` behind to be verified by.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import pinocchio as pin
import scipy
from numpy.typing import NDArray

from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.solve.adjustment import Adjusted
from cell.measure.calibration.solve.joint import view_data
from cell.measure.calibration.solve.normal import (
    BOARD,
    CAMERA,
    COLUMNS,
    FLANGE,
    HAND,
    PLANE,
    POSITION,
    RAIL,
    SHARED,
    AdjustmentState,
    ViewData,
    dots_block,
    stripe_block,
)
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.poses import from_matrix, from_parts
from cell.measure.vision.board.board import board_pose

INTERIM_VIEW, CHECKED_VIEW, CHECKED_LARGE_VIEW = "fine 17", "fine 7", "large 6"
"""The views of a calibration from which each job looks again, and a verification, by its scan and its target camera.

From the second one the rail moves far either way: it is aimed anew, and has no picture to compare with.
"""


@dataclass(frozen=True, eq=False)
class KnownPicture:
    """The calibration's own picture of a board, from where it is looked at again. `base_from_flange` and `rail` (m) are
    as reported then, `camera_from_board` is where that picture alone has the board."""

    base_from_flange: pin.SE3
    rail: float
    camera_from_board: pin.SE3

    @classmethod
    def read(cls, base_from_flange: Array, rail: float, camera_from_board: Array) -> Self:
        """From storage; KeyError, TypeError or ValueError when it is not one."""
        return cls(from_matrix(base_from_flange), float(rail), from_matrix(camera_from_board))

    def as_dict(self) -> dict[str, object]:
        """For storage."""
        poses = {"base_from_flange": self.base_from_flange, "camera_from_board": self.camera_from_board}
        return {"rail": self.rail, **{name: pose.homogeneous.tolist() for name, pose in poses.items()}}

    def measured(self, state: AdjustmentState, like: ViewData) -> ViewData:
        """Its dots, those that a later picture shows of the same board."""
        camera = self.base_from_flange * state.flange_from_camera * from_parts(self.rail * state.rail_direction)
        there = replace(state, base_from_board=camera * self.camera_from_board)
        off, _ = dots_block(there, like, self.base_from_flange, self.rail)
        return replace(like, pixels=like.pixels - off, base_from_flange=self.base_from_flange, rail=self.rail)


@dataclass(frozen=True, eq=False)
class Reference:
    """The board in the arm's base, and the covariance (27, 27) of everything that the calibration estimated.

    The covariance is in the order of `cell.measure.calibration.solve.normal` (camera, light plane, rail, hand-eye,
    board), zero where nothing was estimated, and allows for the scatter that was found. `arm_translation` (m),
    `arm_rotation` (rad) and `rail` (m) are the standard deviations per axis of a flange pose and of a rail reading: as
    configured, or as found where that was more. `repeats` (m, rad) is how well the arm comes back to one posture; files
    of older programs have none. `dots_scale` and `stripe_scale` multiply the stated σ of dots and stripe. `pictures`
    are those of the views from which the board is looked at again.
    """

    base_from_board: pin.SE3
    covariance: Array
    arm_translation: float
    arm_rotation: float
    rail: float
    dots_scale: float
    stripe_scale: float
    repeats: tuple[float, float] = (np.inf, np.inf)
    pictures: Mapping[str, KnownPicture] = field(default_factory=dict)

    @classmethod
    def of(cls, adjusted: Adjusted) -> Self:
        """Of a joint adjustment."""
        excess = {name: max(1.0, adjusted.excess.get(name, 1.0)) for name in ("shift", "turn", "rail")}
        priors = adjusted.priors
        return cls(
            adjusted.state.base_from_board, adjusted.reliable_covariance, priors.arm_translation * excess["shift"],
            arm_rotation=priors.arm_rotation * excess["turn"], rail=priors.rail * excess["rail"],
            dots_scale=priors.dots_scale, stripe_scale=priors.stripe_scale,
            repeats=(priors.arm_translation, priors.arm_rotation),
        )  # fmt: skip

    def as_dict(self) -> dict[str, object]:
        """For storage."""
        return {
            "base_from_board": self.base_from_board.homogeneous.tolist(),
            "covariance": self.covariance.tolist(),
            "sigma": {"arm_translation": self.arm_translation, "arm_rotation": self.arm_rotation, "rail": self.rail},
            "scale": {"dots": self.dots_scale, "stripe": self.stripe_scale},
            **({"repeats": list(self.repeats)} if np.isfinite(self.repeats).all() else {}),
            "pictures": {view: picture.as_dict() for view, picture in self.pictures.items()},
        }

    @classmethod
    def read(cls, data: dict[str, Any] | None) -> Self | None:
        """From storage, None for None; KeyError, TypeError or ValueError when it is not one."""
        if data is None:
            return None
        sigma, scale, (shift, turn) = data["sigma"], data["scale"], data.get("repeats", (np.inf, np.inf))
        return cls(
            from_matrix(data["base_from_board"]),
            np.array(data["covariance"], dtype=np.float64).reshape(SHARED, SHARED), float(sigma["arm_translation"]),
            arm_rotation=float(sigma["arm_rotation"]), rail=float(sigma["rail"]), dots_scale=float(scale["dots"]),
            stripe_scale=float(scale["stripe"]), repeats=(float(shift), float(turn)),
            pictures={view: KnownPicture.read(**picture) for view, picture in data.get("pictures", {}).items()},
        )  # fmt: skip

    def with_pictures(self, observations: Sequence[ScanObservation], camera: CameraModel) -> Self:
        """With the pictures of the calibration's `observations` from where the board is looked at again."""
        again = [o for o in observations if o.name in (INTERIM_VIEW, CHECKED_LARGE_VIEW)]
        return replace(self, pictures={
            o.name: KnownPicture(o.base_from_flange, o.rail_position, board_pose(o.view, camera).camera_from_board)
            for o in again if o.view is not None
        })  # fmt: skip


# The lens model itself is no better than this; it keeps few-thousandths noise from making a test of the model.
LEAST_DOTS_PX = 0.02
# 8 ms at 12 mm/s: generous, so that a busy computer does not look like a moved laser.
SWEEP_RAIL_M = 1e-4
# The same for one picture of a sweep: 4 ms. It is left out of account but for the question whether the stripes are
# straight and flat: a stripe's own scatter, along the laser, would look like the rail's and turn the light plane.
SWEEP_PICTURE_M = 5e-5


@dataclass(frozen=True, eq=False)
class PictureMeasurements:
    """One picture's measurements; `rest` numbers the approach of the arm, `stop` that of the rail, each from 0. A
    `sweeping` rail is one stop: where it was then is as sure as the camera's clock is read, `SWEEP_RAIL_M`."""

    data: ViewData
    rest: int
    stop: int = 0
    sweeping: bool = False


@dataclass(frozen=True, eq=False)
class DriftEvidence:
    """Score (27,) and information (27, 27) of a change of the shared parameters, in the order of the blocks.

    With the calibration as it was, the score has mean 0 and the information as its covariance. The parameters (k,) of
    a change along the columns of a matrix D (27, k) are estimated by (DᵀFD)⁻¹Dᵀs with covariance (DᵀFD)⁻¹.
    `dots` and `stripe` are the RMS of whitened residuals that no move of the camera and no plane explains, 1 for the
    noise that the calibration found; NaN where nothing of the kind was seen.
    """

    score: Array
    information: Array
    dots: float
    stripe: float

    def change(self, directions: Array) -> tuple[Array, Array]:
        """Estimate (k,) and covariance (k, k) of a change along the columns (27, k); any other is excluded."""
        inverse = np.linalg.inv(directions.T @ self.information @ directions)
        return np.asarray(inverse @ directions.T @ self.score), np.asarray(0.5 * (inverse + inverse.T))


def evidence(
    state: AdjustmentState, reference: Reference, looks: Sequence[PictureMeasurements], name: str
) -> DriftEvidence:
    """Weigh looks from the calibration's view of that `name` against it; its values and the board are in `state`.

    With residual r, derivative J of all parameters q and their prior covariance Σ the misfit's covariance is
    S = R + JΣJᵀ. A change shows in the rows D of J that are of `looks`. With H = JᵀR⁻¹J, g = JᵀR⁻¹r and C = DᵀR⁻¹J the
    score DᵀS⁻¹r is DᵀR⁻¹r − CΣ(I + HΣ)⁻¹g, the information DᵀS⁻¹D is DᵀR⁻¹D − CΣ(I + HΣ)⁻¹Cᵀ (matrix inversion lemma).

    What the arm scatters beyond its repeatability is the posture's own, the same at each rest. The calibration's own
    picture from there shows how large that is.
    """
    every = [*looks, *_before(state, reference, looks, name)]
    rests = 1 + max(look.rest for look in every)
    stops = 1 + max(look.stop for look in every)
    size = SHARED + 6 * rests + stops
    prior = np.zeros((size, size))
    prior[:SHARED, :SHARED] = reference.covariance
    arm = np.repeat([reference.arm_translation**2, reference.arm_rotation**2], 3)
    rails = np.full(stops, reference.rail**2)
    rails[[look.stop for look in every if look.sweeping]] += SWEEP_RAIL_M**2
    own = np.minimum(arm, np.repeat(np.square(reference.repeats), 3))
    prior[np.arange(SHARED, size), np.arange(SHARED, size)] = np.concatenate([np.tile(own, rests), rails])
    prior[SHARED : size - stops, SHARED : size - stops] += np.kron(np.ones((rests, rests)), np.diag(arm - own))
    kinds: dict[str, list[tuple[Array, Array]]] = {"dots": [], "stripe": [], "before": []}
    along: list[Array] = []
    for number, look in enumerate(every):
        index = np.concatenate([
            np.arange(SHARED), SHARED + 6 * look.rest + np.arange(6), [SHARED + 6 * rests + look.stop]
        ])  # fmt: skip
        view = look.data
        if len(view.points):
            residual, jacobian = dots_block(state, view, view.base_from_flange, view.rail)
            sigma = np.repeat(np.maximum(reference.dots_scale * view.sigma, LEAST_DOTS_PX), 2)
            kind = "dots" if number < len(looks) else "before"
            kinds[kind].append(_white(residual.ravel(), jacobian.reshape(-1, COLUMNS), sigma, index, size))
        if len(view.stripe) and state.plane is not None:
            residual, jacobian, sigma = stripe_block(state, view, view.base_from_flange, view.rail)
            kinds["stripe"].append(_white(residual, jacobian, reference.stripe_scale * sigma, index, size))
            along.append(kinds["stripe"][-1][1][:, index[-1:]])
    rows = [*kinds["dots"], *kinds["stripe"]]
    by_change, changed = np.sum([j.T @ j for _, j in rows], axis=0), np.sum([j.T @ r for r, j in rows], axis=0)
    normal = by_change + np.sum([j.T @ j for _, j in kinds["before"]], axis=0)
    right = changed + np.sum([j.T @ r for r, j in kinds["before"]], axis=0)
    explained = by_change[:SHARED] @ prior @ np.linalg.inv(np.eye(size) + normal @ prior)
    score = changed[:SHARED] - explained @ right
    information = by_change[:SHARED, :SHARED] - explained @ by_change[:, :SHARED]
    # Dots may be anywhere that a camera's move or lens puts them, the stripe on any plane.
    dots = _misfit(kinds["dots"], np.r_[CAMERA, SHARED:size])
    stripe = _misfit(
        kinds["stripe"], np.r_[BOARD], scipy.linalg.block_diag(*along) * SWEEP_PICTURE_M if along else None
    )
    return DriftEvidence(score, 0.5 * (information + information.T), dots, stripe)


def _before(
    state: AdjustmentState, reference: Reference, looks: Sequence[PictureMeasurements], name: str
) -> list[PictureMeasurements]:
    if (known := reference.pictures.get(name)) is None:
        return []
    rest, stop = 1 + max(look.rest for look in looks), 1 + max(look.stop for look in looks)
    return [PictureMeasurements(known.measured(state, looks[0].data), rest, stop)]


def dots_of(photo: ScanObservation) -> ViewData:
    """The dots of an observation, without its stripe."""
    return view_data(photo, np.empty(0, dtype=np.intp))


def _misfit(rows: list[tuple[Array, Array]], columns: NDArray[np.intp], noise: Array | None = None) -> float:
    """RMS of what is left of whitened residuals (n,) after the best fit of some parameters; NaN without rows. `noise`
    (n, k) is what k further unknowns do to the residuals, each as large as its own standard deviation."""
    if not rows:
        return float("nan")
    residual, jacobian = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    count, chosen = len(residual), jacobian[:, columns]
    if noise is not None:
        known = np.hstack([np.zeros((noise.shape[1], len(columns))), np.eye(noise.shape[1])])
        chosen, residual = np.vstack([np.hstack([chosen, noise]), known]), np.pad(residual, (0, noise.shape[1]))
    chosen = chosen / np.maximum(np.linalg.norm(chosen, axis=0), 1e-30)
    left = residual - chosen @ np.linalg.lstsq(chosen, residual, rcond=1e-9)[0]
    return float(np.sqrt(np.sum(left**2) / count))


def _white(residual: Array, jacobian: Array, sigma: Array, index: NDArray[np.intp], size: int) -> tuple[Array, Array]:
    wide = np.zeros((len(residual), size))
    wide[:, index[:SHARED]] = jacobian[:, :SHARED]
    wide[:, index[SHARED:-1]] = jacobian[:, FLANGE]
    wide[:, index[-1:]] = jacobian[:, POSITION]
    return residual / sigma, wide / sigma[:, None]


SHIFT, TURN = 0.2e-3, float(np.deg2rad(0.05))
"""The disturbance that has to be found, m and rad."""
SCAN_DEPTH, TARGET_DEPTH = 0.13, 0.65
"""Where a shift of a focal length counts, m in front of the camera."""


@dataclass(frozen=True)
class Hypothesis:
    """A change of parameters `index` of one camera's chain, of about `size` each; `part` is what a person would fix."""

    part: str
    index: tuple[int, ...]
    size: tuple[float, ...]


def hypotheses(chain: str, focal: float) -> list[Hypothesis]:
    """What may change in the chain of the "scan" or the "target" camera of `focal` length in px."""
    hand = range(HAND.start, HAND.stop)
    mount, lens = f"{chain} camera's mount on the flange", f"{chain} camera's lens"
    depth = SCAN_DEPTH if chain == "scan" else TARGET_DEPTH
    made = [
        Hypothesis(mount, tuple(hand[:3]), (SHIFT,) * 3), Hypothesis(mount, tuple(hand[3:]), (TURN,) * 3),
        Hypothesis(lens, (2, 3), (TURN * focal,) * 2), Hypothesis(lens, (0, 1), (SHIFT / depth * focal,) * 2),
    ]  # fmt: skip
    if chain == "scan":
        plane, rail = range(PLANE.start, PLANE.stop), range(RAIL.start, RAIL.stop)
        made += [
            Hypothesis("laser's light plane", tuple(plane), (TURN, TURN, SHIFT)),
            Hypothesis("rail", tuple(rail), (TURN,) * 3),
        ]
    return made


def log_factor(weighed: DriftEvidence, h: Hypothesis, scores: Array) -> Array:
    """Logarithms (n,) of the Bayes factor for a Gaussian change of size `h.size` against none, for scores (n, 27)."""
    gain, offset = quadratic(weighed, h)
    s = scores[:, list(h.index)]
    return np.asarray(0.5 * np.einsum("ni,ij,nj->n", s, gain, s, optimize=True) + offset, dtype=np.float64)


def quadratic(weighed: DriftEvidence, h: Hypothesis) -> tuple[Array, float]:
    """The matrix A (k, k) and the number c for which ½ sᵀA s + c is that logarithm for the score s of `h.index`. With
    the change's covariance P and its information F these are (P⁻¹ + F)⁻¹ and −½ log det(1 + F P)."""
    index, size = list(h.index), np.array(h.size)
    information = weighed.information[np.ix_(index, index)] * size[:, None] * size
    posterior = np.eye(len(index)) + information
    gain = np.linalg.inv(posterior) * size[:, None] * size
    return np.asarray(0.5 * (gain + gain.T)), -0.5 * float(np.linalg.slogdet(posterior)[1])


def log_mean(factors: Array) -> Array:
    """Logarithm (n,) of the mean of exp over the last axis of (n, k)."""
    most = factors.max(axis=1)
    return np.asarray(most + np.log(np.mean(np.exp(factors - most[:, None]), axis=1)), dtype=np.float64)
