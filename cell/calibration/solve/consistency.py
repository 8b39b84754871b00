"""Which frames agree with each other: pictures turned or mirrored, or with the pose of another frame, stand out.

The angle by which the flange turned between two frames is the angle by which the camera saw the board turn, whatever
the hand-eye. It also settles the order of boards that look the same turned.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.folder import RecordedFrame
from cell.calibration.solve.hand_eye import park_martin
from cell.geometry.camera import Array, CameraModel
from cell.vision.board.board import board_pose
from cell.vision.pictures import Reason
from drivers.errors import RefusedError

LARGEST_ANGLE = np.deg2rad(3.0)
# A board further from where the others see it than this share of its distance, and than this many times what is
# usual in the folder, was not where the flange pose says.
MISPLACED_SHARE, MISPLACED_RATIO = 0.012, 5.0
REWEIGHTINGS = 40
LEAST_OFF_M = 1e-4


def settle_orders(frames: Sequence[RecordedFrame], camera: CameraModel) -> None:
    """Give boards that look the same turned the order that agrees with the flange's turns, frame after frame."""
    placed: list[tuple[pin.SE3, pin.SE3]] = []
    for frame in frames:
        assert frame.view is not None and frame.base_from_flange is not None
        options = frame.view.turns()
        poses = [board_pose(view, camera).camera_from_board for view in options]
        if placed and len(options) > 1:
            flange = frame.base_from_flange
            misfit = [np.median([angle_apart(flange, pose, f, p) for f, p in placed]) for pose in poses]
            best = int(np.argmin(misfit))
        else:
            best = 0
        frame.view = options[best]
        placed.append((frame.base_from_flange, poses[best]))


def refuse_odd_ones(frames: Sequence[RecordedFrame], camera: CameraModel) -> list[RecordedFrame]:
    """Refuse frames whose turn disagrees with most others by more than 3°; the rest."""
    kept = list(frames)
    poses = {id(f): board_pose(f.view, camera).camera_from_board for f in kept if f.view is not None}
    apart: Array = np.zeros((len(kept), len(kept)))
    for (i, a), (j, b) in product(enumerate(kept), repeat=2):
        if i != j:
            apart[i, j] = angle_apart(a.base_from_flange, poses[id(a)], b.base_from_flange, poses[id(b)])
    index = list(range(len(kept)))
    while len(index) > 2:
        inner = apart[np.ix_(index, index)] + np.diag(np.full(len(index), np.nan))
        typical = np.nanmedian(inner, axis=1)
        worst = int(np.argmax(typical))
        if typical[worst] < LARGEST_ANGLE:
            break
        frame = kept[index[worst]]
        frame.refuse(
            Reason.TURNED,
            f"the board is the wrong way round: it turned by {np.degrees(typical[worst]):.0f}° more or less than the "
            "flange did between this frame and the others; is the picture turned or mirrored, or the pose of another "
            "frame?",
        )
        del index[worst]
    return [kept[i] for i in index]


def refuse_misplaced(frames: Sequence[RecordedFrame], camera: CameraModel) -> list[RecordedFrame]:
    """Refuse frames whose flange pose puts the board far from where the others see it; the rest.

    The worst goes first. Nothing is refused where no hand-eye can be had.
    """
    kept = list(frames)
    while len(kept) > 3:
        try:
            off, reach = _misplacements(kept, camera)
        except RefusedError:
            break
        worst = int(np.argmax(off / reach))
        others = float(np.median(np.delete(off, worst)))
        if off[worst] < max(MISPLACED_SHARE * reach[worst], MISPLACED_RATIO * others):
            break
        kept[worst].refuse(
            Reason.NO_POSE,
            f"the flange pose puts the board {1e3 * off[worst]:.0f} mm from where the other frames see it, which agree "
            f"to {1e3 * others:.1f} mm: is it the pose of another frame, or had the board moved?",
        )
        del kept[worst]
    return kept


def _misplacements(frames: Sequence[RecordedFrame], camera: CameraModel) -> tuple[Array, Array]:
    """How far each frame's board (n,) lies from where most put it, and from the camera (n,), both in m.

    For the camera on the flange or standing before it, whichever fits better.
    """
    boards = [board_pose(f.view, camera).camera_from_board for f in frames if f.view is not None]
    reported = [f.base_from_flange for f in frames if f.base_from_flange is not None]
    reach = np.array([np.linalg.norm(b.translation) for b in boards])
    tried = [_away(flanges, boards) for flanges in (reported, [f.inverse() for f in reported])]
    return min(tried, key=lambda off: float(np.median(off))), reach


def _away(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> Array:
    """Distance (n,) in m of each board's origin from the place, in the base, with the least sum of distances.

    The rotation is Park and Martin's, which wrong positions do not touch; camera and board place by reweighting.
    """
    rotation = park_martin(flanges, boards)
    # R_F (R_X c + t) + t_F = b, linear in t and b.
    design = np.array([np.hstack([f.rotation, -np.eye(3)]) for f in flanges])
    known = np.array(
        [f.rotation @ rotation @ c.translation + f.translation for f, c in zip(flanges, boards, strict=True)]
    )
    off = np.ones(len(flanges))
    for _ in range(REWEIGHTINGS):
        root = np.sqrt(1 / np.maximum(off, LEAST_OFF_M))[:, None]
        solution = np.linalg.lstsq((design * root[:, :, None]).reshape(-1, 6), -(known * root).ravel(), rcond=None)[0]
        off = np.linalg.norm(design @ solution + known, axis=1)
    return off


def angle_apart(a_flange: pin.SE3, a_board: pin.SE3, b_flange: pin.SE3, b_board: pin.SE3) -> float:
    """Difference in rad between the angles of the flange's and the board's turn."""
    hand = float(np.linalg.norm(pin.log3(a_flange.rotation.T @ b_flange.rotation)))
    eye = float(np.linalg.norm(pin.log3(a_board.rotation @ b_board.rotation.T)))
    return abs(hand - eye)
