"""Pairs of poses from two tables without pictures: one of the arm's poses, one of the board's as the camera saw it.

Which is which is told by their names, how the numbers are read by the poses themselves: the flange and the board turn
by the same angles.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.agreement import UNITS, scaled
from cell.calibration.recorded.attach import Options, about_poses
from cell.calibration.recorded.conventions import Reading, readings_of
from cell.calibration.recorded.decide import Decision, clearly_worse, decide
from cell.calibration.recorded.listing import Listing
from cell.calibration.recorded.pairs import LEAST_PAIRS
from cell.calibration.recorded.series import Series, read_series
from drivers.errors import ConfigError, RefusedError

BOARD = re.compile("board|chessboard|checkerboard|target|marker|tag|apriltag|aruco|charuco|chess|pattern|object|obj")
CAMERA = re.compile("optical|cam|camera|eye")
USUAL_M = 0.5
"""Boards are seen from about so far: the unit of their table is the one that comes nearest."""
NEXT = (
    "give two tables with a row for each stop in the same order, named after what they hold, such as robot_poses.csv "
    "(base_from_flange) and board_poses.csv (camera_from_board; the inverse is cam2board.csv)"
)


def pairs_of_tables(
    listing: Listing, options: Options
) -> tuple[list[tuple[pin.SE3, pin.SE3]], dict[str, Any], list[tuple[str, str]]]:
    """Pairs (base_from_flange, camera_from_board) in m, how they were read, and the files that were not understood.

    Raises ConfigError where there are no such tables, RefusedError where they agree in no reading or in several.
    """
    series, _, unread = read_series(listing)
    arm, board = _told_apart([s for s in series if len(s.records) >= LEAST_PAIRS], listing, unread)
    for one in (arm, board):
        one.of, one.by = dict(enumerate(one.records)), "order"
    inverse = goes_inverse(board.name)
    found: list[tuple[Decision, Reading, str, dict[int, pin.SE3]]] = []
    refused: list[str] = []
    for reading in readings_of(board.count, board.named, None):
        poses = board.poses(reading)
        if not poses:
            continue
        far = float(np.median([np.linalg.norm(p.translation) for p in poses.values()]))
        unit = min(UNITS, key=lambda u: abs(math.log(max(far * UNITS[u], 1e-9) / USUAL_M)))
        poses = {k: scaled(p.inverse() if inverse else p, unit) for k, p in poses.items()}
        try:
            decision = decide([arm], {k: [p] for k, p in poses.items()}, 0.0, options.poses, options.setup)
        except RefusedError as error:
            refused.append(str(error))
            continue
        found.append((decision, reading, unit, poses))
    if not found:
        raise RefusedError(f"{arm.name} and {board.name} give no hand-eye: {refused[0] if refused else 'no poses'}")
    decision, reading, unit, seen = min(found, key=lambda f: f[0].best.score)
    for rival, other, *_ in found:
        if other != reading and not clearly_worse(rival.best, decision.best):
            raise RefusedError(
                f"{board.name} can be read in two ways that agree about equally: {reading.text} leaves "
                f"{decision.best.left}, {other.text} leaves {rival.best.left}; write its poses as 4×4 matrices, "
                "camera_from_board in m"
            )
    side = "board_from_camera" if inverse else "camera_from_board"
    unsaid = " (its name does not say; else call it cam2board)" if inverse is None else ""
    about = about_poses(decision, options)
    about |= {"source": [arm.name, board.name]}
    about["text"] += f"; the board's: {reading.text} in {unit}, {side}{unsaid}"
    flanges = arm.poses(decision.best.reading)
    both = sorted(flanges.keys() & seen)
    return [(scaled(flanges[k], decision.best.unit), seen[k]) for k in both], about, [*listing.unread, *unread]


def _told_apart(series: Sequence[Series], listing: Listing, unread: list[tuple[str, str]]) -> tuple[Series, Series]:
    """The arm's table and the board's. Raises ConfigError that says what there is."""
    boards = [s for s in series if any(map(BOARD.fullmatch, _words(s.name)))]
    arms = [s for s in series if s not in boards]
    if len(arms) == 1 and len(boards) == 1:
        if len(arms[0].records) != len(boards[0].records):
            raise ConfigError(
                f"{arms[0].name} holds {len(arms[0].records)} poses and {boards[0].name} {len(boards[0].records)}: "
                "which belong together? Give both the same rows"
            )
        return arms[0], boards[0]
    there = [f"{s.name} ({len(s.records)} poses)" for s in series] or ["no table of poses"]
    said = "".join(f"; {name}: {reason}" for name, reason in [*listing.unread, *unread][:5])
    raise ConfigError(
        f"{listing.folder} holds no pictures; found were {', '.join(there)}{said}. "
        f"For a hand-eye without pictures {NEXT}"
    )


def _words(name: str) -> list[str]:
    """The words of a file's name, also of one such as board2cam or boardToCam."""
    return re.findall(r"[a-z]+|2", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())


def goes_inverse(name: str) -> bool | None:
    """Whether a table holds board_from_camera, as its name says (cam2board, camera_wrt_target); None where it does not.

    The poses do not say it: with the board's inverse a camera on the flange looks like one that stands, and both agree.
    """
    words = _words(name)
    board, camera = ([k for k, word in enumerate(words) if kind.fullmatch(word)] for kind in (BOARD, CAMERA))
    if len(board) != 1 or len(camera) != 1:
        return None
    first, second = sorted((board[0], camera[0]))
    between = words[first + 1 : second]
    if any(word in ("2", "to", "wrt", "in", "rel", "relative") for word in between):
        return camera[0] < board[0]
    # As in T_cam_board, cam_T_board, cam_from_board: what is right of it goes into what is left of it.
    if any(word in ("from", "t", "h") for word in [*between, *words[max(0, first - 1) : first]]):
        return board[0] < camera[0]
    return None
