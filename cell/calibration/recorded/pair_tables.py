"""Pairs of poses from two tables without pictures: one of the arm's poses, one of the board's as the camera saw it.

Which is which is told by their names, how the numbers are read by the poses themselves: the flange and the board turn
by the same angles.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.agreement import UNITS, scaled
from cell.calibration.recorded.attach import Options
from cell.calibration.recorded.conventions import Reading, readings_of
from cell.calibration.recorded.decide import Decision, clearly_worse, decide
from cell.calibration.recorded.listing import Listing
from cell.calibration.recorded.pairs import LEAST_PAIRS
from cell.calibration.recorded.series import Series, read_series
from cell.calibration.solve.consistency import turns_apart
from drivers.errors import ConfigError, RefusedError

BOARD = "board|chessboard|checkerboard|target|marker|tag|apriltag|aruco|charuco|chess|pattern|object|obj"
CAMERA = "optical|cam|camera|eye"
ARM = "robot|arm|flange|gripper|hand|tcp|tool|end|ee|eef|effector|base|wrist|link|joint"
USUAL_M = 0.5
"""Boards are seen from about so far: the unit of their table is the one that comes nearest."""
LOOKED_AT = 24
"""Rows that tell how the tables are read."""
LIKELY, LEAST_SHARE = 3.0, 0.002
"""Readings of the board's table are tried whose turns differ from the flange's by so many times the best share."""
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
    count = len(arm.records)
    some = np.unique(np.linspace(0, count - 1, LOOKED_AT).astype(int)).tolist()
    for one in (arm, board):
        one.of, one.by = {k: one.records[k] for k in some}, "order"
    found: list[tuple[Decision, Seen]] = []
    refused: list[str] = []
    for likely in _likely(arm, board, options.poses):
        boards = {k: [pose] for k, pose in likely.poses(board).items()}
        try:
            found.append((decide([arm], boards, 0.0, options.poses, options.setup, shifts=()), likely))
        except RefusedError as error:
            refused.append(str(error))
    if not found:
        raise RefusedError(f"{arm.name} and {board.name} give no hand-eye: {refused[0]}")
    found.sort(key=lambda f: f[0].best.score)
    decision, chosen = found[0]
    if len(found) > 1 and not clearly_worse(found[1][0].best, decision.best):
        raise RefusedError(
            f"{board.name} can be read in two ways that agree about equally: {chosen.text} leaves "
            f"{decision.best.left}, {found[1][1].text} leaves {found[1][0].best.left}; write its "
            "poses as 4×4 matrices, camera_from_board in m"
        )
    for one in (arm, board):
        one.of = dict(enumerate(one.records))
    flanges, seen = arm.poses(decision.best.reading), chosen.poses(board)
    kept = [k for k in range(count) if k in flanges and k in seen]
    about = {
        "source": [arm.name, board.name],
        "reading": decision.best.reading.name,
        "text": f"{decision.best.reading.text}; the board's: {chosen.text}",
        "unit": decision.best.unit,
        "setup": decision.best.setup,
        "matched_by": "order",
        "given": [n for n in ("poses", "setup") if getattr(options, n)],
        "evidence": decision.evidence,
        "turn_deg": math.degrees(decision.best.turn),
        "shift_mm": 1e3 * decision.best.shift,
    }
    return [(scaled(flanges[k], decision.best.unit), seen[k]) for k in kept], about, [*listing.unread, *unread]


def _told_apart(series: Sequence[Series], listing: Listing, unread: list[tuple[str, str]]) -> tuple[Series, Series]:
    """The arm's table and the board's. Raises ConfigError that says what there is."""
    leaning = [(_leaning(s.name), s) for s in series]
    arms, boards = [s for w, s in leaning if w < 0], [s for w, s in leaning if w > 0]
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


def _leaning(name: str) -> int:
    """How many more of a name's words are of the board and the camera than of the arm."""
    return sum(
        (re.fullmatch(f"{BOARD}|{CAMERA}", word) is not None) - (re.fullmatch(ARM, word) is not None)
        for word in _words(name)
    )


def _words(name: str) -> list[str]:
    """The words of a file's name, also of one such as board2cam or boardToCam."""
    apart = re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower()
    return [word for word in re.split(r"[^a-z]+", apart) if word]


@dataclass(frozen=True)
class Seen:
    """How the board's table is read: the numbers, their unit, and whether the poses are those of the camera.

    `inverse` is None where the table's name does not say it: then they are taken for the board's.
    """

    reading: Reading
    unit: str
    inverse: bool | None

    @property
    def text(self) -> str:
        """In words."""
        side = "board_from_camera" if self.inverse else "camera_from_board"
        unsaid = " (its name does not say; else call it cam2board)" if self.inverse is None else ""
        return f"{self.reading.text} in {self.unit}, {side}{unsaid}"

    def poses(self, board: Series) -> dict[int, pin.SE3]:
        """camera_from_board in m by row."""
        found = {k: scaled(pose, self.unit) for k, pose in board.poses(self.reading).items()}
        return {k: pose.inverse() for k, pose in found.items()} if self.inverse else found


def _likely(arm: Series, board: Series, wanted: str | None) -> list[Seen]:
    """The readings of the board's table whose turns may be those of a reading of the arm's, the likeliest first."""
    flanges = [arm.poses(reading) for reading in readings_of(arm.count, arm.named, wanted)]
    tried: list[tuple[float, Seen]] = []
    for reading in readings_of(board.count, board.named, None):
        poses = board.poses(reading)
        misfits = [turns_apart(_common(f, poses), _common(poses, f)) for f in flanges if len(f.keys() & poses) > 2]
        if misfits:
            far = float(np.median([np.linalg.norm(p.translation) for p in poses.values()]))
            unit = min(UNITS, key=lambda u: abs(math.log(max(far * UNITS[u], 1e-9) / USUAL_M)))
            tried.append((min(misfits), Seen(reading, unit, _inverse(board.name))))
    least = min((misfit for misfit, _ in tried), default=0.0)
    kept: list[Seen] = []
    for misfit, seen in sorted(tried, key=lambda t: t[0]):
        if misfit <= LIKELY * least + LEAST_SHARE and not any(_same(seen, other, board) for other in kept):
            kept.append(seen)
    return kept


def _inverse(name: str) -> bool | None:
    """Whether a table holds board_from_camera, as its name says (cam2board, camera_wrt_target); None where it does not.

    The poses do not say it: with the board's inverse a camera on the flange looks like one that stands, and both agree.
    """
    words = re.findall(r"[a-z]+|2", " ".join(re.split(r"[_\W]", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())))
    board, camera = ([k for k, word in enumerate(words) if re.fullmatch(kind, word)] for kind in (BOARD, CAMERA))
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


def _same(a: Seen, b: Seen, board: Series) -> bool:
    """True for readings that give the same poses."""
    first, second = a.poses(board), b.poses(board)
    return first.keys() == second.keys() and all(
        np.allclose(first[k].homogeneous, second[k].homogeneous, atol=1e-6) for k in first
    )


def _common(poses: dict[int, pin.SE3], others: dict[int, pin.SE3]) -> list[pin.SE3]:
    return [poses[k] for k in sorted(poses.keys() & others.keys())]
