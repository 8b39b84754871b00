"""Is a camera that was given that of the pictures? Its focal length and principal point, against what they give.

The pictures' own adjustment has the given lens, so that terms which stand for each other do not hide a difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.measure.calibration.judge.checks import QualityCheck
from cell.measure.calibration.solve.intrinsics import LEAST_LEFT_OUT, Intrinsics, beside_given
from cell.measure.geometry.camera import PARAMETER_NAMES
from cell.measure.vision.board.view import BoardView
from drivers.errors import RefusedError

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
