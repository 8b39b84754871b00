"""Is the camera known, and is its lens the one that the model has? Deviations, residual map, terms against priors.

Is a camera that was given that of the pictures? Its focal length and principal point, against what they give.

The pictures' own adjustment has the given lens, so that terms which stand for each other do not hide a difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.measure.calibration.judge.board_shape import USUAL
from cell.measure.calibration.judge.checks import QualityCheck
from cell.measure.calibration.solve.adjustment import DISTORTION_PRIOR
from cell.measure.calibration.solve.intrinsics import CENTRED_LENS, LEAST_LEFT_OUT, Intrinsics, beside_given
from cell.measure.geometry.camera import PARAMETER_NAMES, Array, CameraModel, seen_centres
from cell.measure.geometry.poses import transform
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.board.view import BoardView
from drivers.errors import RefusedError

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

    `names` are those of the views.
    """
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
    made.append(
        QualityCheck(
            "intrinsics", "σ of the focal length", focal, doubt=2.0, refuse=10.0, unit="%",
            says=f"{len(views)} views give fx = {camera.fx:.0f} ± {found.sigma[0]:.0f} px; {advice}",
        )
    )  # fmt: skip
    made.append(
        QualityCheck(
            "intrinsics", "σ of the principal point", centre, doubt=3.0, refuse=10.0, unit="% of the picture",
            says=f"({camera.cx:.0f} ± {found.sigma[2]:.0f}, {camera.cy:.0f} ± {found.sigma[3]:.0f}) px; {advice}",
        )
    )  # fmt: skip
    made.append(_tilt(views, camera))
    made.append(_terms(found))
    if len(found.pull):
        made.append(_pulls(found, names))
    if found.bend is not None and found.bend.believed:
        made.append(
            QualityCheck(
                "intrinsics", "bend of the board", 100 * found.bend.share, 100 * USUAL, 3.0, unit="% of its diagonal",
                says=f"{1e3 * found.bend.height:.2f} ± {1e3 * found.bend.sigma:.2f} mm out of a plane, which moves fx "
                f"by {abs(found.bend.camera[0]):.1f} px and the principal point by "
                f"{float(np.hypot(*found.bend.camera[2:4])):.1f} px; glue it to something flat",
            )
        )  # fmt: skip
    return made


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
    likely = np.concatenate([usual @ np.linalg.solve(usual + pictures.covariance[:4, :4], apart), np.zeros(5)])
    covariance = given.covariance + np.outer(likely, likely)
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
