"""Which frames agree with each other: pictures turned or mirrored, or with the pose of another frame, stand out.

The angle by which the flange turned between two frames is the angle by which the camera saw the board turn, whatever
the hand-eye. It also settles the order of boards that look the same turned.
"""

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from cell.apps.recordings.frames import RecordedFrame, by_stop, merged
from cell.measure.calibration.solve.starts import park_martin
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.pictures import Reason
from drivers.errors import RefusedError

# Turns that differ by so much, and by so many times what is usual in the folder, are of another pose or picture.
LEAST_ANGLE, ODD_ANGLE_RATIO = float(np.deg2rad(0.5)), 5.0
MOST_ODD = 0.45
# A board further from where the others see it than this share of its distance, and than this many times what is
# usual in the folder, was not where the flange pose says.
MISPLACED_SHARE, MISPLACED_RATIO = 0.008, 6.0
LEAST_JUDGES = 5
"""Others that a frame has to disagree with before it is blamed: of fewer, any may be the one that is wrong."""
REWEIGHTINGS = 40
ORDER_ROUNDS, REFERENCES = 5, 12
LEAST_OFF_M = 1e-4


def settle_orders(frames: Sequence[RecordedFrame], camera: CameraModel) -> None:
    """Give boards that look the same turned the order that agrees with the flange's turns."""
    options = [[] if f.view is None else f.view.turns() for f in frames]
    if all(len(views) < 2 for views in options):
        return
    poses = [[board_pose(view, camera).camera_from_board for view in views] for views in options]
    chosen = orders([f.base_from_flange for f in frames], poses)
    for frame, views, turn in zip(frames, options, chosen, strict=True):
        frame.view = views[turn]


def orders(flanges: Sequence[pin.SE3], options: Sequence[Sequence[pin.SE3]]) -> list[int]:
    """Which of the poses (camera_from_board) that a board may have goes, in each frame, with the flange's turns.

    Each of some frames is taken for right in turn, so that none has to be; what most frames agree with is kept. All
    boards turned together are the same: then the first frame keeps its first pose.
    """
    of = np.repeat(np.arange(len(options)), [len(poses) for poses in options])
    first = np.concatenate([[0], np.cumsum([len(poses) for poses in options])[:-1]])
    seen = [pose for poses in options for pose in poses]
    apart = np.abs(turns_between([flanges[k] for k in of.tolist()]) - turns_between(seen))
    found: list[tuple[float, int, list[int]]] = []
    references: list[int] = np.unique(np.linspace(0, len(options) - 1, REFERENCES).astype(int)).tolist()
    for k in references:
        for right in range(len(options[k])):
            reference = apart[first[k] + right]
            chosen = [int(np.argmin(reference[a : a + len(p)])) for a, p in zip(first, options, strict=True)]
            for _ in range(ORDER_ROUNDS):
                before, among = chosen, first + chosen
                typical = np.median(apart[:, among], axis=1)
                chosen = [int(np.argmin(typical[a : a + len(p)])) for a, p in zip(first, options, strict=True)]
                if chosen == before:
                    break
            among = first + chosen
            misfit = float(np.sum(np.median(apart[np.ix_(among, among)], axis=1)))
            found.append((round(misfit, 9), chosen[0], chosen))
    return min(found, key=lambda one: one[:2])[2]


def refuse_odd_ones(frames: Sequence[RecordedFrame], camera: CameraModel) -> list[RecordedFrame]:
    """Refuse frames whose turn disagrees with most others by far more than these with each other; the rest."""
    boards, flanges = _poses(frames, camera)
    odd = odd_turns(flanges, boards)
    for k, off in odd.items():
        frames[k].refuse(
            Reason.TURNED,
            f"the board is the wrong way round: it turned by {np.degrees(off):.1f}° more or less than the "
            "flange did between this frame and the others; is the picture turned or mirrored, or the pose of another "
            "frame?",
        )
    return [f for k, f in enumerate(frames) if k not in odd]


def refuse_misplaced(frames: Sequence[RecordedFrame], camera: CameraModel) -> list[RecordedFrame]:
    """Refuse frames whose flange pose puts the board far from where the others see it; the rest. Frames of one stop are
    judged as one."""
    stops = by_stop(frames)
    boards, flanges = _poses([merged(stop) for stop in stops], camera)
    for k, (off, others) in misplacements(flanges, boards).items():
        for frame in stops[k]:
            frame.refuse(
                Reason.NO_POSE,
                f"the flange pose puts the board {1e3 * off:.0f} mm from where the other frames see it, which agree "
                f"to {1e3 * others:.1f} mm: is it the pose of another frame, had the board moved, or is the picture "
                "cropped or scaled?",
            )
    return [f for f in frames if f.reason is None]


def odd_turns(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> dict[int, float]:
    """The frames that disagree about the turns with most others, worst first, and by how much in rad. Nothing is odd
    where most frames disagree with most others: then it is the poses that are read wrongly."""
    count = len(flanges)
    apart, votes = np.abs(turns_between(flanges) - turns_between(boards)), turn_votes(flanges, boards)
    odd: dict[int, float] = {}
    index = list(range(count))
    while len(index) > 2:
        inner = np.ix_(index, index)
        typical = weighted_median(apart[inner], votes[inner])
        worst = int(np.argmax(typical))
        usual = float(np.median(np.delete(typical, worst)))
        if typical[worst] < max(LEAST_ANGLE, ODD_ANGLE_RATIO * usual):
            break
        odd[index[worst]] = float(typical[worst])
        del index[worst]
    return odd if len(odd) < MOST_ODD * count else {}


def misplacements(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> dict[int, tuple[float, float]]:
    """The frames that put the board elsewhere than most, worst first: how far in m, and how well the others agree.
    Nothing is misplaced where no hand-eye can be had, or where most frames would be."""
    index, found = list(range(len(flanges))), {}
    # Frames of one orientation put the board wherever the hand-eye has it: they tell little of what is usual.
    votes = turn_votes(flanges, boards)
    while len(index) > LEAST_JUDGES:
        try:
            off, reach = _misplacements([flanges[k] for k in index], [boards[k] for k in index])
        except RefusedError:
            break
        worst = int(np.argmax(off / reach))
        # Six unknowns of 3 n figures follow the frames: of a few, what is left over is smaller than their scatter.
        left = len(index) - 1
        usual = weighted_median(np.delete(off, worst), np.delete(votes[np.ix_(index, index)].sum(axis=1), worst))
        others = float(usual) * np.sqrt(left / (left - 2))
        if off[worst] < max(MISPLACED_SHARE * reach[worst], MISPLACED_RATIO * others):
            break
        found[index[worst]] = (float(off[worst]), others)
        del index[worst]
    return found if len(found) < MOST_ODD * len(flanges) else {}


def _poses(frames: Sequence[RecordedFrame], camera: CameraModel) -> tuple[list[pin.SE3], list[pin.SE3]]:
    boards = [board_pose(f.view, camera).camera_from_board for f in frames if f.view is not None]
    return boards, [f.base_from_flange for f in frames if f.base_from_flange is not None]


def _misplacements(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> tuple[Array, Array]:
    """How far each frame's board (n,) lies from where most put it, and from the camera (n,), both in m. For the camera
    on the flange or standing before it, whichever fits better."""
    reach = np.array([np.linalg.norm(b.translation) for b in boards])
    both = (flanges, [f.inverse() for f in flanges])
    # The rotation is Park and Martin's, which wrong positions do not touch.
    tried = [board_shifts(poses, boards, park_martin(poses, boards), 1.0)[0] for poses in both]
    return min(tried, key=lambda off: float(np.median(off))), reach


def board_shifts(
    flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3], rotation: Array, size: float | None
) -> tuple[Array, float, float, Array]:
    """How far boards lie from one place in the base, for the place of the camera that makes this least.

    Returns the distances (n,) in m of their origins, the size of the poses' unit in m, its σ, and the camera's place
    (3,) in m in the flange. `rotation` (3, 3) is flange_from_camera. The sum of the distances is least, by reweighting.
    With `size` None the unit's size is found with the rest.
    """
    turns, ways = np.array([f.rotation for f in flanges]), np.array([f.translation for f in flanges])
    right = turns @ rotation @ np.array([b.translation for b in boards])[:, :, None]
    whole = np.concatenate([turns, np.broadcast_to(-np.eye(3), turns.shape), ways[:, :, None]], axis=2)
    right = right[:, :, 0]
    if size is not None:
        whole, right = whole[:, :, :6], right + size * ways
    # An arm's base may be metres away and its unit mm: columns of one size keep the system well conditioned.
    norms = np.linalg.norm(whole.reshape(-1, whole.shape[2]), axis=0) + 1e-12
    off = np.ones(len(whole))
    for _ in range(REWEIGHTINGS):
        root = np.sqrt(1 / np.maximum(off, LEAST_OFF_M))[:, None]
        a = (whole / norms * root[:, :, None]).reshape(-1, len(norms))
        solution = np.linalg.lstsq(a, -(right * root).ravel(), rcond=None)[0]
        off = np.linalg.norm(whole / norms @ solution + right, axis=1)
    place = solution[:3] / norms[:3]
    if size is not None:
        return off, size, 0.0, place
    left = float(np.sum((a @ solution + (right * root).ravel()) ** 2)) / max(1, a.shape[0] - a.shape[1])
    sigma = math.sqrt(left * float(np.linalg.pinv(a.T @ a)[-1, -1]))
    return off, float(solution[-1] / norms[-1]), float(sigma / norms[-1]), place


def turn_votes(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> Array:
    """Weights (n, n) of each two frames' vote on a rotation: views that do not turn agree with any, and have none. By
    the smaller turn of flange and board: a picture that is the wrong way round must not outvote the others."""
    votes = np.sin(0.5 * np.minimum(turns_between(flanges), turns_between(boards))) ** 2
    np.fill_diagonal(votes, 0.0)
    return np.asarray(votes)


def weighted_median(values: Array, weights: Array) -> Array:
    """Medians along the last axis of values (…, n) with weights (…, n), the largest value that has half the weight."""
    order = np.argsort(values, axis=-1)
    share = np.cumsum(np.take_along_axis(weights, order, -1), axis=-1)
    middle = np.argmax(share >= 0.5 * share[..., -1:], axis=-1)
    return np.asarray(np.take_along_axis(np.take_along_axis(values, order, -1), middle[..., None], -1)[..., 0])


def turns_between(poses: Sequence[pin.SE3]) -> Array:
    """Angles (n, n) in rad between the rotations of each two poses."""
    rotations = np.array([p.rotation for p in poses]).reshape(-1, 3, 3)
    traces = np.einsum("aij,bij->ab", rotations, rotations)
    return np.asarray(np.arccos(np.clip(0.5 * (traces - 1), -1.0, 1.0)))
