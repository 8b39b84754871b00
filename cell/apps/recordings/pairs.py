"""The hand-eye from a folder that holds pairs of poses only, flange and board, without pictures."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from cell.apps.recordings.agreement import OWN_SHARE, along_axes
from cell.apps.recordings.consistency import misplacements, odd_turns
from cell.apps.recordings.frames import SAME_M, SAME_RAD, counted, grouped, near
from cell.apps.recordings.result import RecordedResult, closed_form_figures, hand_eye_figures, setup_note
from cell.apps.recordings.series import Listing
from cell.apps.recordings.texts import decoded, structured
from cell.measure.calibration.judge.checks import QualityCheck
from cell.measure.calibration.judge.scale import metric_scale
from cell.measure.calibration.solve.starts import HandEye, refine_hand_eye, solve_hand_eye
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import difference, from_matrix, mean
from cell.measure.vision.pictures import Reason
from drivers.errors import ConfigError, RefusedError

Pair = tuple[pin.SE3, pin.SE3]
"""base_from_flange and camera_from_board, in m."""
LEAST_PAIRS = 4
CLEARLY = 5.0
"""Times as much scatter as in the other set-up: then it is not the one that a person named."""
"""Of stops, not of pairs."""
FARTHEST_M = {"the flange's distance from the base": 10.0, "the board's distance from the camera": 20.0}
USUAL_SHARE = 0.01
"""Of the board's distance: farther a board seldom is from where the other pairs put it."""
SAME_BOARD_SHARE = 1e-3
"""Poses of boards in m within this share of their distance are of one place."""


def read_pose_pairs(listing: Listing) -> list[Pair]:
    """Pairs from the JSON file of a folder that holds such a list; empty when none does.

    Raises ConfigError for a list of pairs with a matrix that is no pose, for two such lists, and for a file that cannot
    be read where there is nothing else.
    """
    found: dict[Path, Array] = {}
    for path in listing.texts:
        if path.suffix.lower() != ".json":
            continue
        try:
            data = structured(".json", decoded(path.read_bytes()))
        except (ValueError, OSError, RecursionError) as error:
            if not listing.pictures:
                raise ConfigError(f"{path}: {error}; give it whole, or take it out of the folder") from error
            continue
        try:
            pairs = np.asarray(data, dtype=np.float64)
        except (ArithmeticError, ValueError, TypeError):
            continue
        if pairs.ndim == 4 and pairs.shape[1:] == (2, 4, 4):
            found[path] = pairs
    if len(found) > 1:
        names = ", ".join(map(listing.name, found))
        raise ConfigError(f"{listing.folder}: pairs of poses are in {names}; put them into one list, or give one file")
    return [pair for path, pairs in found.items() for pair in _poses(path, pairs)]


def _poses(path: Path, pairs: Array) -> list[Pair]:
    made = []
    for k, (flange, board) in enumerate(pairs):
        if not np.isfinite(pairs[k]).all():
            raise ConfigError(f"{path}: pair {k} holds a value that is no finite number; correct or remove the pair")
        try:
            made.append((from_matrix(flange), from_matrix(board)))
        except ValueError as error:
            raise ConfigError(
                f"{path}: pair {k}: {error}. Numbers that stand by columns are to be transposed; a left-handed frame "
                "is to be turned into a right-handed one"
            ) from error
    return made


def calibrate_pairs(pairs: Sequence[Pair], wanted: str | None = None) -> RecordedResult:
    """Hand-eye from pairs, camera on the flange or standing before the board: as is `wanted`, or as the poses tell.
    Pairs that do not agree with most are left out and named. Raises ConfigError when they give none."""
    _check_unit(pairs)
    result = RecordedResult()
    stops = grouped(range(len(pairs)), lambda a, b: _one_stop(pairs[a], pairs[b]))
    means = [(mean([pairs[k][0] for k in stop]), mean([pairs[k][1] for k in stop])) for stop in stops]
    odd = _wrong(means)
    wrong = {k: text for of, text in odd.items() for k in stops[of]}
    for k in range(len(pairs)):
        reason = str(Reason.NO_POSE) if k in wrong else None
        frame = {"name": f"pair {k}", "used": k not in wrong, "reason": reason}
        result.frames.append({**frame, "text": wrong.get(k, ""), "rms_px": None})
    kept = [pair for k, pair in enumerate(means) if k not in odd]
    if len(stops) < len(pairs):
        same = "pairs of one stop share its error and count as one"
        result.notes.append(f"{counted(len(pairs), len(stops), 'pairs')}: {same}")
    if len(kept) < LEAST_PAIRS:
        raise ConfigError(
            f"pairs of poses of {len(kept)} stops agree with each other; a hand-eye that can be checked needs "
            f"{LEAST_PAIRS}"
        )
    boards = [board for _, board in kept]
    setup, closed, flanges = _closed_form(kept, wanted)
    refined, sigma, off = refine_hand_eye(flanges, boards, closed)
    left_out, found = float(np.sqrt(np.mean(off**2))), refined.flange_from_camera
    reach = float(np.median([np.linalg.norm(b.translation) for b in boards]))
    sigma = _stated(sigma, left_out, reach)
    method, scatter = "Park-Martin, then robust least squares on the poses", (refined.scatter_m, refined.scatter_rad)
    result.hand_eye = {
        **hand_eye_figures(setup, method, found, scatter, sigma), "left_out": {"board_mm": 1e3 * left_out},
        "frames": len(kept), "closed_form": closed_form_figures(setup, closed),
    }  # fmt: skip
    result.notes += setup_note(setup, found)
    result.notes.append("pairs of poses only: no intrinsics, no light plane, no flatness")
    checks = _checks(difference(found, closed.flange_from_camera), sigma, left_out, reach=reach, count=len(kept))
    checks += _in_the_origin(setup, found, reach)
    scale = metric_scale(flanges, boards)
    result.apply(checks + ([] if scale is None else [scale.check(checks)]))
    return result


def _stated(sigma: Array, left_out: float, reach: float) -> Array:
    """The deviations (6,), in m and rad, of pairs that put the board so far, m, from where the others see it. Beyond
    what is usual that is no chance of single pairs: the board may have been moved in the midst of them."""
    if left_out <= USUAL_SHARE * reach:
        return sigma
    return np.concatenate([np.maximum(sigma[:3], left_out / math.sqrt(3.0)), np.maximum(sigma[3:], left_out / reach)])


def _in_the_origin(setup: str, found: pin.SE3, reach: float) -> list[QualityCheck]:
    """A doubt where the hand-eye is next to none, as of poses that are inverted."""
    far, origin = float(np.linalg.norm(found.translation)), "flange" if setup == "eye_in_hand" else "base"
    if far > OWN_SHARE * reach or not along_axes(found.rotation):
        return []
    says = f"the camera would be {1e3 * far:.1f} mm from the {origin}'s origin and along its axes: is the second of "
    says += "each pair the camera as the board sees it? Invert it"
    return [QualityCheck("hand_eye", "a camera at the origin", 1.0, doubt=0.5, refuse=math.inf, unit="", says=says)]


def _closed_form(pairs: Sequence[Pair], wanted: str | None) -> tuple[str, HandEye, list[pin.SE3]]:
    """Set-up, hand-eye and flange poses, the camera on the flange or before it: as is `wanted`, or whichever scatters
    the board less. Raises ConfigError for what is `wanted` where the other scatters it far less."""
    solutions: list[tuple[str, HandEye, list[pin.SE3]]] = []
    for setup in ("eye_in_hand", "eye_to_hand"):
        flanges = [f if setup == "eye_in_hand" else f.inverse() for f, _ in pairs]
        try:
            solutions.append((setup, solve_hand_eye(flanges, [board for _, board in pairs]), flanges))
        except RefusedError as error:
            raise ConfigError(f"the {len(pairs)} pairs of poses give no hand-eye: {error}") from error
    best = min(solutions, key=lambda solution: solution[1].scatter_m)
    said = next((solution for solution in solutions if solution[0] == wanted), best)
    if said[1].scatter_m > CLEARLY * best[1].scatter_m:
        raise ConfigError(
            f"--setup {said[0].replace('_', '-')}: the pairs put the board {1e3 * said[1].scatter_m:.0f} mm apart so, "
            f"and {1e3 * best[1].scatter_m:.1f} mm as {best[0].replace('_', ' ')}; leave --setup out, or invert poses"
        )
    return said


def _checks(apart: Array, sigma: Array, left_out: float, *, reach: float, count: int) -> list[QualityCheck]:
    """Of a hand-eye (6,) `apart` from its closed form, with its σ (6,), in m and rad; `left_out` and `reach` in m."""
    far, place = 1e3 * float(np.linalg.norm(apart[:3])), 1e3 * float(sigma[:3].max())
    advice = f"from {count} pairs; turn the flange about two axes by 20° or more, to several sides"
    strange = (
        f"{1e3 * left_out:.1f} mm from where the others put it: the arm scatters, or the poses are not of one set-up "
        "(another convention, a unit other than m, a board that moved)"
    )
    share, sigmas = 0.1 / reach, float(np.max(np.abs(apart) / np.maximum(sigma, 1e-9)))
    most = 6.0 if share * far > 3.0 else math.inf
    return [
        QualityCheck("hand_eye", name, value, doubt=doubt, refuse=refused, unit=unit, says=text)
        for name, value, doubt, refused, unit, text in (
            ("σ of its place", share * place, 1.0, 5.0, "% of the board's distance", f"{place:.1f} mm {advice}"),
            ("σ of its turn", math.degrees(float(sigma[3:].max())), 0.6, 3.0, "deg", advice),
            ("board in left-out pairs", 1e3 * share * left_out, 100 * USUAL_SHARE, 5.0, "% of its distance", strange),
            ("closed form against least squares", sigmas, 3.0, most, "σ", f"{far:.1f} mm apart"),
        )
    ]


def _one_stop(a: Pair, b: Pair) -> bool:
    reach = float(np.linalg.norm(a[1].translation))
    return near(a[0], b[0]) and near(a[1], b[1], max(SAME_M, SAME_BOARD_SHARE * reach), 2 * SAME_RAD)


def _check_unit(pairs: Sequence[Pair]) -> None:
    """Refuse positions that cannot be in m. Raises ConfigError."""
    for place, (what, farthest) in enumerate(FARTHEST_M.items()):
        far = float(np.median([np.linalg.norm(pair[place].translation) for pair in pairs]))
        if not 0.0 < far <= farthest:
            raise ConfigError(
                f"pairs of poses: {what} would be {far:.4g} m (median, allowed: above 0, up to {farthest:g} m); "
                "both positions of a pair must be in m: are these in mm? Divide them by 1000"
            )


def _wrong(pairs: Sequence[Pair]) -> dict[int, str]:
    """Pairs that disagree with most others, and why."""
    flanges, boards = [f for f, _ in pairs], [b for _, b in pairs]
    turned = odd_turns(flanges, boards)
    said = "more or less than the flange between this pair and the others"
    found = {k: f"the board turned by {math.degrees(off):.1f}° {said}" for k, off in turned.items()}
    index = [k for k in range(len(pairs)) if k not in turned]
    for k, (off, others) in misplacements([flanges[k] for k in index], [boards[k] for k in index]).items():
        found[index[k]] = (
            f"it puts the board {1e3 * off:.0f} mm from where the others see it, which agree to {1e3 * others:.1f} mm"
        )
    return found
