"""The hand-eye from a folder that holds pairs of poses only, flange and board, without pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pinocchio as pin

from cell.calibration.recorded.result import closed_form_dict, empty_result, hand_eye_dict
from cell.calibration.solve.hand_eye import HandEye, refine_hand_eye, solve_hand_eye
from drivers.errors import ConfigError, RefusedError


def calibrate_pairs(pairs: Sequence[tuple[pin.SE3, pin.SE3]]) -> dict[str, Any]:
    """Hand-eye from pairs (base_from_flange, camera_from_board), camera on the flange or standing before the board.

    Raises ConfigError when they give none.
    """
    solutions: list[tuple[str, HandEye, HandEye]] = []
    boards = [board for _, board in pairs]
    for setup in ("eye_in_hand", "eye_to_hand"):
        flanges = [f if setup == "eye_in_hand" else f.inverse() for f, _ in pairs]
        try:
            closed = solve_hand_eye(flanges, boards)
        except RefusedError as error:
            raise ConfigError(f"the {len(pairs)} pairs of poses give no hand-eye: {error}") from error
        solutions.append((setup, closed, refine_hand_eye(flanges, boards, closed)))
    setup, closed, refined = min(solutions, key=lambda s: s[1].scatter_m)
    result = empty_result(None)
    del result["frames_rms"]
    result["frames"] = [
        {"name": f"pair {k}", "used": True, "reason": None, "text": "", "rms_px": None} for k in range(len(pairs))
    ]
    result["hand_eye"] = {
        "method": "Park-Martin, then robust least squares on the poses",
        **hand_eye_dict(setup, refined.flange_from_camera),
        "scatter_mm": 1e3 * refined.scatter_m,
        "scatter_deg": math.degrees(refined.scatter_rad),
        "frames": len(pairs),
        "closed_form": closed_form_dict(setup, closed),
    }
    result["notes"].append("pairs of poses only: no intrinsics, no light plane, no flatness")
    return result
