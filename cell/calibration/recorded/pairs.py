"""The hand-eye from a folder that holds pairs of poses only, flange and board, without pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.result import closed_form_dict, empty_result, hand_eye_dict, setup_note
from cell.calibration.recorded.solution import apply_checks
from cell.calibration.recorded.stops import counted, mean_pair, pairs_by_stop
from cell.calibration.solve.checks import Check
from cell.calibration.solve.consistency import misplacements, odd_turns
from cell.calibration.solve.hand_eye import HandEye, refine_hand_eye, solve_hand_eye
from cell.calibration.solve.scale import metric_scale
from cell.geometry.camera import Array
from cell.geometry.poses import difference
from cell.vision.pictures import Reason
from drivers.errors import ConfigError, RefusedError

LEAST_PAIRS = 4
"""Of stops, not of pairs."""
FARTHEST_M = {"the flange's distance from the base": 10.0, "the board's distance from the camera": 20.0}


def calibrate_pairs(pairs: Sequence[tuple[pin.SE3, pin.SE3]]) -> dict[str, Any]:
    """Hand-eye from pairs (base_from_flange, camera_from_board), camera on the flange or standing before the board.

    Pairs that do not agree with most are left out and named. Raises ConfigError when they give none.
    """
    _check_unit(pairs)
    result = empty_result(None)
    del result["frames_rms"]
    stops = pairs_by_stop(pairs)
    means = [mean_pair([pairs[k] for k in stop]) for stop in stops]
    odd = _wrong(means)
    wrong = {k: text for of, text in odd.items() for k in stops[of]}
    result["frames"] = [
        {
            "name": f"pair {k}", "used": k not in wrong, "reason": str(Reason.NO_POSE) if k in wrong else None,
            "text": wrong.get(k, ""), "rms_px": None,
        }
        for k in range(len(pairs))
    ]  # fmt: skip
    kept = [pair for k, pair in enumerate(means) if k not in odd]
    if len(stops) < len(pairs):
        result["notes"].append(
            f"{counted(len(pairs), len(stops), 'pairs')}: pairs of one stop share its error and count as one"
        )
    if len(kept) < LEAST_PAIRS:
        raise ConfigError(
            f"pairs of poses of {len(kept)} stops agree with each other; a hand-eye that can be checked needs "
            f"{LEAST_PAIRS}"
        )
    boards = [board for _, board in kept]
    solutions: list[tuple[str, HandEye, list[pin.SE3]]] = []
    for setup in ("eye_in_hand", "eye_to_hand"):
        flanges = [f if setup == "eye_in_hand" else f.inverse() for f, _ in kept]
        try:
            solutions.append((setup, solve_hand_eye(flanges, boards), flanges))
        except RefusedError as error:
            raise ConfigError(f"the {len(pairs)} pairs of poses give no hand-eye: {error}") from error
    setup, closed, flanges = min(solutions, key=lambda s: s[1].scatter_m)
    refined, sigma, off = refine_hand_eye(flanges, boards, closed)
    result["hand_eye"] = {
        "method": "Park-Martin, then robust least squares on the poses",
        **hand_eye_dict(setup, refined.flange_from_camera),
        "scatter_mm": 1e3 * refined.scatter_m,
        "scatter_deg": math.degrees(refined.scatter_rad),
        "sigma_mm": (1e3 * sigma[:3]).tolist(),
        "sigma_deg": np.degrees(sigma[3:]).tolist(),
        "left_out": {"board_mm": 1e3 * float(np.sqrt(np.mean(off**2)))},
        "frames": len(kept),
        "closed_form": closed_form_dict(setup, closed),
    }
    result["notes"] += [
        *setup_note(setup, refined.flange_from_camera),
        "pairs of poses only: no intrinsics, no light plane, no flatness",
    ]
    scale = metric_scale(flanges, boards)
    checks = _checks(refined, closed, sigma, off, boards)
    apply_checks(checks + ([] if scale is None else [scale.check(checks)]), result)
    return result


def _check_unit(pairs: Sequence[tuple[pin.SE3, pin.SE3]]) -> None:
    """Refuse positions that cannot be in m. Raises ConfigError."""
    said = []
    for place, (what, farthest) in enumerate(FARTHEST_M.items()):
        far = float(np.median([np.linalg.norm(pair[place].translation) for pair in pairs]))
        if far > farthest:
            said.append(f"{what} would be {far:.4g} m (median, allowed {farthest:g} m)")
    if not said:
        return
    mixed = "" if len(said) == len(FARTHEST_M) else "the two poses of a pair seem to have different units: "
    raise ConfigError(
        f"pairs of poses: {mixed}{' and '.join(said)}; positions must be in m: are these in mm? Divide them by 1000"
    )


def _wrong(pairs: Sequence[tuple[pin.SE3, pin.SE3]]) -> dict[int, str]:
    """Pairs that disagree with most others, and why."""
    flanges, boards = [f for f, _ in pairs], [b for _, b in pairs]
    turned = odd_turns(flanges, boards)
    found = {
        k: f"the board turned by {math.degrees(off):.1f}° more or less than the flange between this pair and the others"
        for k, off in turned.items()
    }
    index = [k for k in range(len(pairs)) if k not in turned]
    misplaced = misplacements([flanges[k] for k in index], [boards[k] for k in index])
    for k, (off, others) in misplaced.items():
        found[index[k]] = (
            f"it puts the board {1e3 * off:.0f} mm from where the others see it, which agree to {1e3 * others:.1f} mm"
        )
    return found


def _checks(refined: HandEye, closed: HandEye, sigma: Array, off: Array, boards: Sequence[pin.SE3]) -> list[Check]:
    reach = float(np.median([np.linalg.norm(b.translation) for b in boards]))
    left_out = float(np.sqrt(np.mean(off**2)))
    apart = difference(refined.flange_from_camera, closed.flange_from_camera)
    far = 100 * float(np.linalg.norm(apart[:3])) / reach
    advice = f"from {len(boards)} pairs; turn the flange about two axes by 20° or more, to several sides"
    return [
        Check(
            "hand_eye", "σ of its place", 100 * float(sigma[:3].max()) / reach, 1.0, 5.0, "% of the board's distance",
            f"{1e3 * sigma[:3].max():.1f} mm {advice}",
        ),
        Check("hand_eye", "σ of its turn", math.degrees(float(sigma[3:].max())), 0.6, 3.0, "deg", advice),
        Check(
            "hand_eye", "board in left-out pairs", 100 * left_out / reach, 1.0, 5.0, "% of its distance",
            f"{1e3 * left_out:.1f} mm from where the others put it: the arm scatters, or the poses are not of one "
            "set-up (another convention, a unit other than m, a board that moved)",
        ),
        Check(
            "hand_eye", "closed form against least squares", float(np.max(np.abs(apart) / np.maximum(sigma, 1e-9))),
            3.0, 6.0 if far > 3.0 else math.inf, "σ", f"{1e3 * float(np.linalg.norm(apart[:3])):.1f} mm apart",
        ),
    ]  # fmt: skip
