"""Pictures of one stop of the arm are one measurement: they share the arm's error, the board's place and its print.

Counted as several they would seem to check each other, and the deviations that come from leaving one out would mean
nothing. So each stop becomes one frame: the mean of its points and of its poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.folder import RecordedFrame
from cell.geometry.poses import difference, mean
from cell.vision.board.view import BoardView

# Two pictures are of one stop when their boards lie at the same pixels, as well as a corner is found in a poor
# picture, and their flange poses, where there are any, differ by no more than a standing arm's reading does.
SAME_PX = 0.5
SAME_M, SAME_RAD = 5e-4, 1e-3
SAME_BOARD_SHARE = 1e-3
"""Poses of boards in m within this share of their distance are of one place."""
LEAST_SHARED = 0.5


def by_stop(frames: Sequence[RecordedFrame]) -> list[list[RecordedFrame]]:
    """The frames with a view, those of one stop together, in the order of their first."""
    stops: list[list[RecordedFrame]] = []
    for frame in frames:
        stop = next((s for s in stops if _same_stop(s[0], frame)), None)
        if stop is None:
            stops.append([frame])
        else:
            stop.append(frame)
    return stops


def merged(stop: Sequence[RecordedFrame]) -> RecordedFrame:
    """One frame for a stop, named like its first: mean points and pose, the stripe that covers most rows.

    The points' σ stays that of one picture: what is wrong with a corner at a place is wrong in every picture of it.
    """
    first = stop[0]
    assert first.view is not None
    if len(stop) == 1:
        return first
    views = [view for f in stop if f.view is not None and (view := _like(first.view, f.view)) is not None]
    ids = np.unique(np.concatenate([v.ids for v in views]))
    place = [np.searchsorted(ids, v.ids) for v in views]
    count, sigma, pixels = np.zeros(len(ids)), np.zeros(len(ids)), np.zeros((len(ids), 2))
    for at, view in zip(place, views, strict=True):
        count[at] += 1
        sigma[at] += view.sigma
        pixels[at] += view.pixels
    view = replace(first.view, ids=ids, pixels=pixels / count[:, None], sigma=sigma / count)
    poses = [f.base_from_flange for f in stop if f.base_from_flange is not None]
    stripes = [f.profile for f in stop if f.profile is not None]
    return RecordedFrame(
        first.path,
        first.name,
        view,
        max(stripes, key=lambda p: len(p.rows)) if stripes else None,
        mean(poses) if poses else None,
    )


def pairs_by_stop(pairs: Sequence[tuple[pin.SE3, pin.SE3]]) -> list[list[int]]:
    """Indices of the pairs (base_from_flange, camera_from_board), those of one stop together."""
    stops: list[list[int]] = []
    for k, pair in enumerate(pairs):
        stop = next((s for s in stops if _same_pair(pairs[s[0]], pair)), None)
        if stop is None:
            stops.append([k])
        else:
            stop.append(k)
    return stops


def mean_pair(pairs: Sequence[tuple[pin.SE3, pin.SE3]]) -> tuple[pin.SE3, pin.SE3]:
    """The pair of a stop: its mean poses."""
    return mean([f for f, _ in pairs]), mean([b for _, b in pairs])


def counted(pictures: int, stops: int, what: str = "pictures") -> str:
    """How many there are, for people: `12 pictures of 4 stops`, or `4 frames` where each is a stop of its own."""
    return f"{stops} frames" if pictures == stops else f"{pictures} {what} of {stops} stops"


def _same_stop(a: RecordedFrame, b: RecordedFrame) -> bool:
    if a.view is None or b.view is None or _like(a.view, b.view) is None:
        return False
    if a.base_from_flange is None or b.base_from_flange is None:
        return a.base_from_flange is b.base_from_flange
    return _near(a.base_from_flange, b.base_from_flange)


def _same_pair(a: tuple[pin.SE3, pin.SE3], b: tuple[pin.SE3, pin.SE3]) -> bool:
    reach = float(np.linalg.norm(a[1].translation))
    return _near(a[0], b[0]) and _near(a[1], b[1], max(SAME_M, SAME_BOARD_SHARE * reach), 2 * SAME_RAD)


def _near(a: pin.SE3, b: pin.SE3, metres: float = SAME_M, turn: float = SAME_RAD) -> bool:
    apart = difference(a, b)
    return bool(np.linalg.norm(apart[:3]) <= metres and np.linalg.norm(apart[3:]) <= turn)


def _like(first: BoardView, other: BoardView) -> BoardView | None:
    """The other view in the order that puts its points where the first has them; None where none does."""
    for view in other.turns():
        _, mine, its = np.intersect1d(first.ids, view.ids, return_indices=True)
        if len(mine) < LEAST_SHARED * max(len(first.ids), len(view.ids)):
            continue
        off = np.linalg.norm(first.pixels[mine] - view.pixels[its], axis=1)
        if np.sqrt(np.mean(off**2)) <= SAME_PX:
            return view
    return None
