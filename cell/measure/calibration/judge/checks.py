"""Absolute checks of a calibration: figures beside limits that do not come from the same fit.

A check that fails refuses the part that it is about; one that is doubtful is said beside the result. Here are those of
a camera, given or from pictures, of a hand-eye, and of the cell's own joint adjustment.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import pinocchio as pin

from cell.measure.calibration.solve.adjustment import DISTORTION_PRIOR
from cell.measure.calibration.solve.intrinsics import (
    CENTRED_LENS,
    LEAST_LEFT_OUT,
    USUAL,
    Bend,
    Intrinsics,
    beside_given,
)
from cell.measure.calibration.solve.normal import HAND, stripe_block
from cell.measure.geometry.camera import PARAMETER_NAMES, Array, CameraModel, seen_centres
from cell.measure.geometry.poses import difference, transform
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.board.view import BoardView
from drivers.errors import RefusedError

if TYPE_CHECKING:
    from cell.measure.calibration.solve.choice import Choice
    from cell.measure.calibration.solve.joint import Joint

Part = Literal["intrinsics", "hand_eye", "light_plane"]
Verdict = Literal["ok", "doubt", "refused"]


@dataclass(frozen=True)
class QualityCheck:
    """One figure beside the value from which it is doubtful and that from which the part is refused."""

    part: Part
    name: str
    value: float
    doubt: float
    refuse: float
    unit: str
    says: str
    """What is the matter when it is not well, with the numbers and what to do."""

    @property
    def verdict(self) -> Verdict:
        """What the figure says; one that is not a number is refused."""
        if not self.value < self.refuse:
            return "refused"
        return "ok" if self.value < self.doubt else "doubt"

    @property
    def text(self) -> str:
        """The words for people; empty when all is well."""
        if self.verdict == "ok":
            return ""
        limit = self.refuse if self.verdict == "refused" else self.doubt
        unit = f" {self.unit}" if self.unit else ""
        figure = (
            f"{self.value:.3g}{unit}, {'allowed' if self.verdict == 'refused' else 'usual'} below {limit:.3g}{unit}"
        )
        return f"{self.part.replace('_', '-')}: {self.name} is {figure}: {self.says}"

    def as_dict(self) -> dict[str, object]:
        """For the JSON."""
        return {
            "part": self.part, "name": self.name, "value": self.value if abs(self.value) < float("inf") else None,
            "doubt_from": self.doubt, "refused_from": self.refuse if self.refuse < float("inf") else None,
            "unit": self.unit, "verdict": self.verdict, "text": self.text,
        }  # fmt: skip


def refused_parts(checks: Iterable[QualityCheck]) -> dict[str, list[QualityCheck]]:
    """The checks that fail, by part."""
    found: dict[str, list[QualityCheck]] = {}
    for check in checks:
        if check.verdict == "refused":
            found.setdefault(check.part, []).append(check)
    return found


CELLS = (8, 6)
LEAST_IN_CELL = 6
LEAST_TILT_DEG = 20.0
"""By so much the board has to be tilted from one picture to another. 24 sets of a bent board that was tilted by 5 to
20° gave focal lengths up to 33 stated deviations off; 23 sets of another one, tilted by 44 to 66°, none beyond 1.7."""
STRONG_PULL = 4.0
"""Cook's distance from which a picture is named; in clean sets of 4 to 9 pictures the largest is 3."""


def camera_checks(
    found: Intrinsics, views: Sequence[BoardView], names: Sequence[str], *, given: bool = False
) -> list[QualityCheck]:
    """Checks of a camera from pictures: how well it is known, how it fits, what is systematic in what is left over.
    `names` are those of the views."""
    camera = found.camera
    width = max(camera.width, camera.height)
    off, board = _residuals(views, camera)
    rms = float(np.sqrt(np.mean(off**2))) * np.sqrt(2)
    made = [
        QualityCheck(
            "intrinsics", "RMS of the board's points", 1e3 * rms / width, 1.0, refuse=5.0, unit="‰ of the picture",
            says=f"{rms:.2f} px: board, lens model or pictures are not what they are taken for",
        ),
        _map(off, views, camera, board),
    ]  # fmt: skip
    if given:
        return made
    focal = 100 * float(np.max(found.sigma[:2] / camera.parameters[:2]))
    centre = 100 * float(np.max(found.sigma[2:4])) / width
    advice = "tilt the board more, to several sides and up to 45°, and cover the whole picture"
    made += [
        QualityCheck(
            "intrinsics", "σ of the focal length", focal, doubt=2.0, refuse=10.0, unit="%",
            says=f"{len(views)} views give fx = {camera.fx:.0f} ± {found.sigma[0]:.0f} px; {advice}",
        ),
        QualityCheck(
            "intrinsics", "σ of the principal point", centre, doubt=3.0, refuse=10.0, unit="% of the picture",
            says=f"({camera.cx:.0f} ± {found.sigma[2]:.0f}, {camera.cy:.0f} ± {found.sigma[3]:.0f}) px; {advice}",
        ),
        _tilt(views, camera),
        _terms(found),
    ]  # fmt: skip
    if len(found.pull):
        made.append(_pulls(found, names))
    if found.bend is not None and found.bend.believed:
        made.append(_bend(found.bend))
    return made


def _bend(bend: Bend) -> QualityCheck:
    return QualityCheck(
        "intrinsics", "bend of the board", 100 * bend.share, 100 * USUAL, 3.0, unit="% of its diagonal",
        says=f"{1e3 * bend.height:.2f} ± {1e3 * bend.sigma:.2f} mm out of a plane, which moves fx by "
        f"{abs(bend.camera[0]):.1f} px and the principal point by {float(np.hypot(*bend.camera[2:4])):.1f} px; glue it "
        "to something flat",
    )  # fmt: skip


def _pulls(found: Intrinsics, names: Sequence[str]) -> QualityCheck:
    """How far one picture moves the camera of the others: a picture of another camera or focus does, fit as it may."""
    strong = [k for k in np.argsort(-found.pull) if found.pull[k] >= STRONG_PULL]
    said = ", ".join(names[k] for k in strong)
    return QualityCheck(
        "intrinsics", "what one picture does to the camera", float(found.pull.max()), doubt=STRONG_PULL, refuse=np.inf,
        unit="(Cook's distance)",
        says=f"without {said}, one at a time, focal length or principal point is another one, by more than the points' "
        "scatter allows: was one of them taken by another camera, with another focus or crop, or is the board bent? "
        "Calibrate without it and compare",
    )  # fmt: skip


def _tilt(views: Sequence[BoardView], camera: CameraModel) -> QualityCheck:
    """How differently the board faces the camera: seen alike throughout, its form and the focal length look alike."""
    facing = np.array([board_pose(view, camera).camera_from_board.rotation[:, 2] for view in views])
    tilt = float(np.degrees(np.arccos(np.clip(facing @ facing.T, -1.0, 1.0)).max()))
    return QualityCheck(
        "intrinsics", "needed tilt of the board over what it had", LEAST_TILT_DEG / max(tilt, 0.1), doubt=1.0,
        refuse=np.inf, unit="",
        says=f"from one picture to another the board was tilted by {tilt:.0f}° at most, so that a board that is bent a "
        f"little, too little to be seen, moves fx = {camera.fx:.0f} px by more than is stated; tilt it by 45°, to "
        "several sides",
    )  # fmt: skip


def _terms(found: Intrinsics) -> QualityCheck:
    """The lens's largest term against what lenses have."""
    usual = np.array([*DISTORTION_PRIOR[:2], CENTRED_LENS, CENTRED_LENS, DISTORTION_PRIOR[4]])
    shift = np.abs(np.array(found.camera.dist)) / usual
    worst = int(np.argmax(shift))
    return QualityCheck(
        "intrinsics", f"{PARAMETER_NAMES[4 + worst]} against what lenses have", float(shift[worst]), doubt=3.0,
        refuse=np.inf, unit="σ",
        says=f"{found.camera.dist[worst]:.3g} where {usual[worst]:g} is usual: a lens of another kind (fisheye), a "
        "board that is bent, or pictures that do not tell",
    )  # fmt: skip


def _map(off: Array, views: Sequence[BoardView], camera: CameraModel, board: Array) -> QualityCheck:
    """What repeats in the residuals, by place in the picture and by point of the board, and which of both it is."""
    pixels = np.concatenate([v.pixels for v in views])
    at = np.clip((pixels / (camera.width, camera.height) * CELLS).astype(int), 0, np.array(CELLS) - 1)
    by_picture = _systematic(off, at[:, 0] + CELLS[0] * at[:, 1])
    by_board = _systematic(off, board)
    largest = max(by_picture, by_board)
    noise = float(np.sqrt(np.mean(off**2)))
    if by_picture >= by_board:
        words = (
            "by place in the picture: the lens is not what the model has (a fisheye, or a scaled or cropped picture)"
        )
    else:
        words = "by point of the board: the board is bent or not printed to size"
    return QualityCheck(
        "intrinsics", "what repeats in the residuals", largest, max(0.25, 0.8 * noise), max(3.0, 1e-3 * camera.width),
        unit="px", says=f"{largest:.2f} px RMS of {noise:.2f} px repeat {words}",
    )  # fmt: skip


def _systematic(off: Array, group: Array) -> float:
    """RMS in px of the groups' means beyond what noise makes; residuals (n, 2), groups (n,)."""
    _, member, count = np.unique(group, return_inverse=True, return_counts=True)
    enough = count >= LEAST_IN_CELL
    if not enough.any():
        return 0.0
    means = np.column_stack([np.bincount(member, off[:, k]) for k in (0, 1)]) / count[:, None]
    within = float(np.mean((off - means[member]) ** 2))
    weight = count[enough]
    beyond = np.mean(means[enough] ** 2, axis=1) - within / weight
    return float(np.sqrt(max(0.0, np.average(beyond, weights=weight))))


def _residuals(views: Sequence[BoardView], camera: CameraModel) -> tuple[Array, Array]:
    """Residuals (n, 2) in px of all views at their best poses, and the points' ids (n,)."""
    off = []
    for view in views:
        pose = board_pose(view, camera).camera_from_board
        points = transform(pose, view.object_points)
        if view.dot_radius > 0:
            points = seen_centres(points, pose.rotation[:, 2], view.dot_radius)
        off.append(view.pixels - camera.project(points))
    return np.concatenate(off), np.concatenate([v.ids for v in views])


DOUBT_SIGMAS, REFUSE_SIGMAS = 3.0, 6.0
REFUSE_SHARE = 0.005
"""Of the distance: less than that is not refused, however well the pictures tell it."""
USUAL_SHARE = 0.01
"""Of the focal length: by so much a camera may be off since it was calibrated (focus, warmth, another mode)."""


def against_pictures(given: Intrinsics, views: Sequence[BoardView]) -> tuple[Intrinsics, list[QualityCheck]]:
    """The given camera with the deviation that its difference from the pictures' camera makes likely, and the check.

    `views` are of different stops. With fewer than four, or where they give no camera, it is taken to be off by what
    is usual since a camera was calibrated, and that is doubtful.
    """
    try:
        if len(views) < LEAST_LEFT_OUT:
            return _unchecked(given, f"{len(views)} stops do not tell another camera from this one")
        pictures = beside_given(given.camera, views)
    except (RefusedError, np.linalg.LinAlgError) as error:
        return _unchecked(given, f"the pictures give no camera to compare with ({error})")
    apart = given.camera.parameters[:4] - pictures.camera.parameters[:4]
    sigma = np.maximum(pictures.sigma[:4], 1e-9)
    focal = given.camera.parameters[[0, 1, 0, 1]]
    worst = int(np.argmax(np.abs(apart) / sigma))
    # A difference counts as an error of the given camera as far as the pictures know better than that is usual.
    usual = np.diag((USUAL_SHARE * focal) ** 2)
    believed = usual @ np.linalg.inv(usual + pictures.covariance[:4, :4])
    likely, covariance = believed @ apart, given.covariance.copy()
    # What the pictures do not tell stays open: where they agree with it by chance, it is known no better.
    covariance[:4, :4] += np.outer(likely, likely) + usual - believed @ usual
    far = np.abs(apart) / focal > REFUSE_SHARE
    refuse = REFUSE_SIGMAS if np.any(far & (np.abs(apart) / sigma >= REFUSE_SIGMAS)) else np.inf
    check = QualityCheck(
        "intrinsics", "given camera against that of the pictures", float(np.abs(apart[worst]) / sigma[worst]),
        doubt=DOUBT_SIGMAS, refuse=refuse, unit="σ",
        says=f"{PARAMETER_NAMES[worst]} is given as {given.camera.parameters[worst]:.1f} px, these pictures have "
        f"{pictures.camera.parameters[worst]:.1f} ± {sigma[worst]:.1f} px: is it the file of another camera, focus, "
        "picture size or crop? Leave --camera out, or calibrate the camera anew",
    )  # fmt: skip
    return replace(given, sigma=np.sqrt(np.diag(covariance)), covariance=covariance), [check]


def _unchecked(given: Intrinsics, why: str) -> tuple[Intrinsics, list[QualityCheck]]:
    """The given camera where nothing speaks for or against it."""
    covariance = given.covariance.copy()
    covariance[:4, :4] += np.diag((USUAL_SHARE * given.camera.parameters[[0, 1, 0, 1]]) ** 2)
    check = QualityCheck(
        "intrinsics", "given camera, not checked", 1.0, doubt=0.5, refuse=np.inf, unit="",
        says=f"{why}; focal length and principal point are taken to be off by {100 * USUAL_SHARE:.0f} % of the focal "
        f"length since it was calibrated; take {LEAST_LEFT_OUT} stops or more, the board tilted to several sides",
    )  # fmt: skip
    return replace(given, sigma=np.sqrt(np.diag(covariance)), covariance=covariance), [check]


LEAST_FRAMES = 6
SHIFT_SHARE = 3.0
"""Percent of the distance to the board beyond which closed form and adjustment may not differ, whatever their σ."""


def hand_eye_checks(choice: Choice, boards: Sequence[pin.SE3], pictures: Intrinsics) -> list[QualityCheck]:
    """Checks of the solution that was chosen; `boards` are camera_from_board."""
    best = choice.best
    reach = float(np.median([np.linalg.norm(b.translation) for b in boards]))
    shift, turn = best.sigma[HAND][:3], best.sigma[HAND][3:]
    off = best.left.figures["board_mm"]
    arm_mm = 1e3 * choice.arm[0]
    count = len(boards)
    over = float(np.max(best.scatter[HAND] / np.maximum(best.formal[HAND], 1e-9))) if best.joint else 0.0
    made = [
        QualityCheck(
            "hand_eye", "σ of its place", 100 * float(shift.max()) / reach, 1.0, 5.0, unit="% of the board's distance",
            says=f"{_mm(shift)} mm from {count} frames; turn the flange about two axes by 20° or more, to "
            "several sides",
        ),
        QualityCheck(
            "hand_eye", "σ of its turn", math.degrees(float(turn.max())), doubt=0.6, refuse=3.0, unit="deg",
            says=f"from {count} frames; turn the flange about two axes by 20° or more, to several sides",
        ),
        QualityCheck(
            "hand_eye", "board in left-out frames", 100 * off / 1e3 / reach, 1.0, refuse=5.0, unit="% of its distance",
            says=f"{off:.1f} mm from where the other frames put it at the reported poses: the arm scatters (about "
            f"{arm_mm:.2g} mm and {math.degrees(choice.arm[1]):.2g}° an axis), or poses and pictures do not belong "
            "together",
        ),
        QualityCheck(
            "hand_eye", "the arm's scatter", arm_mm, doubt=2.0, refuse=9.9, unit="mm",
            says=f"{math.degrees(choice.arm[1]):.2g}° beside it, by variance components with the camera of the "
            "pictures",
        ),
        QualityCheck(
            "hand_eye", "scatter of left-out solutions over the formal σ", over, 3.0, refuse=math.inf, unit="",
            says="the residuals are not independent noise; the larger of both is stated",
        ),
        _closed_against(choice, reach),
    ]  # fmt: skip
    if count < LEAST_FRAMES:
        made.append(
            QualityCheck(
                "hand_eye", "frames that are missing", LEAST_FRAMES - count, doubt=0.5, refuse=math.inf, unit="",
                says=f"{count} frames check each other little; take {LEAST_FRAMES} or more",
            )
        )  # fmt: skip
    made += _camera_against(choice, pictures)
    return made


def _closed_against(choice: Choice, reach: float) -> QualityCheck:
    best, closed = choice.best, choice.closed
    a, b = best.adjusted.state.flange_from_camera, closed.adjusted.state.flange_from_camera
    apart = difference(a, b)
    # Both follow the camera and the frames in much the same way: the larger of both is what they may differ by.
    sigma = np.maximum(np.maximum(best.sigma[HAND], closed.sigma[HAND]), 1e-9)
    worst = float(np.max(np.abs(apart) / sigma)) if best.joint else 0.0
    far = 100 * float(np.linalg.norm(apart[:3])) / reach
    return QualityCheck(
        "hand_eye", "closed form against adjustment", worst, 3.0, 6.0 if far > SHIFT_SHARE else math.inf, unit="σ",
        says=f"{1e3 * float(np.linalg.norm(apart[:3])):.1f} mm and "
        f"{math.degrees(float(np.linalg.norm(apart[3:]))):.2f}° apart",
    )  # fmt: skip


def _camera_against(choice: Choice, pictures: Intrinsics) -> list[QualityCheck]:
    """The camera that the arm would have, against that of the pictures."""
    nearest = choice.with_arm
    if nearest is None or not pictures.sigma[:4].all():
        return []
    camera = nearest.adjusted.state.camera.parameters[:4]
    apart = np.abs(camera - pictures.camera.parameters[:4]) / pictures.sigma[:4]
    worst = int(np.argmax(apart))
    kept = "kept is that of the arm and the pictures" if choice.best.camera_free else "kept is that of the pictures"
    return [
        QualityCheck(
            "hand_eye", "camera with the arm against camera from the pictures", float(apart[worst]), doubt=3.0,
            refuse=math.inf, unit="σ",
            says=f"{PARAMETER_NAMES[worst]} would be {camera[worst]:.1f} px, by the pictures it is "
            f"{pictures.camera.parameters[worst]:.1f} ± {pictures.sigma[worst]:.1f} px; {kept}: the arm, the board's "
            "size or the lens is not what it is taken for",
        )
    ]  # fmt: skip


def _mm(values: Array) -> str:
    return " × ".join(f"{1e3 * v:.1f}" for v in values)


def joint_checks(joint: Joint, nominal: CameraModel) -> list[QualityCheck]:
    """Checks of an adjustment against its closed form, the drawing's camera, its priors and its own noise."""
    adjusted, state = joint.adjusted, joint.adjusted.state
    reach = float(np.median([np.linalg.norm(b.translation) for b in joint.staged.camera_from_board]))
    apart = difference(state.flange_from_camera, joint.staged.hand_eye.flange_from_camera)
    shift, turn = 1e3 * float(np.linalg.norm(apart[:3])), math.degrees(float(np.linalg.norm(apart[3:])))
    focal = 100 * float(np.max(np.abs(state.camera.parameters[:2] / nominal.parameters[:2] - 1)))
    lens = np.abs(np.array(state.camera.dist)) / np.array(adjusted.priors.lens)
    worst = int(np.argmax(lens))
    excess = max(adjusted.excess.get("shift", 1.0), adjusted.excess.get("turn", 1.0))
    made = [
        QualityCheck(
            "hand_eye", "closed form against adjustment", shift / 10 / reach, doubt=2.0, refuse=8.0,
            unit="% of the board's distance",
            says=f"{shift:.2f} mm and {turn:.3f}° apart; see whether the views turn the flange about two axes",
        ),
        QualityCheck(
            "hand_eye", "the arm's scatter over what is configured", excess, doubt=4.0, refuse=9.9, unit="",
            says="the arm repeats worse than the configuration says, or something moved in between",
        ),
        QualityCheck(
            "intrinsics", "focal length against the drawing", focal, doubt=6.0, refuse=20.0, unit="%",
            says=f"{state.camera.fx:.0f} px, drawn {nominal.fx:.0f} px: is it the lens that the configuration names?",
        ),
        QualityCheck(
            "intrinsics", f"{PARAMETER_NAMES[4 + worst]} against what lenses have", float(lens[worst]), 3.0, math.inf,
            unit="σ", says=f"{state.camera.dist[worst]:.3g}: is it the lens that the configuration names?",
        ),
    ]  # fmt: skip
    parts, noise = [], []
    for view, flange, rail in zip(joint.views, state.flanges, state.rails.tolist(), strict=True):
        if len(view.stripe) and state.plane is not None:
            parts.append(state.plane.intersect(state.camera.rays(view.stripe)))
            noise.append(stripe_block(state, view, flange, rail)[2])
    if parts:
        own = float(np.sqrt(np.mean(np.concatenate(noise) ** 2)))
        made.append(plane_fit_check(adjusted.stripe_rms_m, own, np.concatenate(parts)))
    return made


def plane_fit_check(rms: float, own: float, cloud: Array) -> QualityCheck:
    """The RMS (m) of a plane's points (n, 3) against their span, beside the stripe's own σ (m)."""
    size = float(np.linalg.norm(np.ptp(cloud, axis=0)))
    return QualityCheck(
        "light_plane", "RMS of the stripe's points", 100 * rms / size, 0.8, refuse=2.0, unit="% of the span they cover",
        says=f"{1e3 * rms:.2f} mm over {1e3 * size:.0f} mm, where the stripe's own noise makes {1e3 * own:.3f} mm: the "
        "points are not those of one plane; are there two lines, something else that shines, a stripe that is of "
        "another frame, or a laser that came on while the rows of a rolling shutter were exposed?",
    )  # fmt: skip
