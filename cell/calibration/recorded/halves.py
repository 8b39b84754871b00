"""Poses in two halves: all rotations in one array or file, all positions in another, as OpenCV's solvers take them.

Which halves belong together is told by their names (R_gripper2base and t_gripper2base), or there are only these two.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.calibration.recorded.records import Record
from cell.geometry.camera import Array

LEAST = 3
TURN_WORDS = re.compile(r"r|rot|rots|rotations?|rmats?|rvecs?|rotvecs?|q|quats?|quaternions?|euler|rpy|orientations?")
PLACE_WORDS = re.compile(r"t|trans|translations?|tvecs?|pos|positions?|xyz|p")
ORTHOGONAL_OFF = 1e-2


@dataclass(frozen=True, eq=False)
class Half:
    """One array of a file: `rows` (n, 9) rotation matrices, (n, 4) quaternions, or (n, 3) positions or rotations."""

    path: Path
    field: str
    rows: Array

    @property
    def words(self) -> list[str]:
        """The words of file and field."""
        apart = re.sub(r"([a-z])([A-Z])", r"\1 \2", f"{self.path.stem} {self.field}").lower()
        return [w for w in re.split(r"[^a-z]+", apart) if w]

    @property
    def turns(self) -> bool:
        """True for rotations: nine or four numbers each, or three that are called so and not positions."""
        if self.rows.shape[1] != 3:
            return True
        words = self.words
        return any(map(TURN_WORDS.fullmatch, words)) and not any(map(PLACE_WORDS.fullmatch, words))

    @property
    def called(self) -> bool:
        """True where a name says which half it is."""
        return any(TURN_WORDS.fullmatch(w) or PLACE_WORDS.fullmatch(w) for w in self.words)

    @property
    def rest(self) -> tuple[str, ...]:
        """What is left of the name without the words that say which half it is."""
        return tuple(w for w in self.words if not TURN_WORDS.fullmatch(w) and not PLACE_WORDS.fullmatch(w))


def half_of(array: Array) -> Array | None:
    """The rows of an array that is one half of at least three poses, or None."""
    if not np.isfinite(array).all():
        return None
    if array.ndim == 3 and array.shape[1:] in ((3, 1), (1, 3), (4, 1), (1, 4), (3, 3)):
        rows = array.reshape(len(array), -1)
    elif array.ndim == 2 and array.shape[1] == 3 and _matrices(array):
        rows = array.reshape(-1, 9)
    elif array.ndim == 2 and (array.shape[1] in (3, 9) or _unit(array)):
        rows = array
    else:
        return None
    if rows.shape[1] == 9 and not _matrices(rows.reshape(-1, 3)):
        return None
    return rows if len(rows) >= LEAST else None


def _matrices(rows: Array) -> bool:
    """True for 3×3 rotations one below the other."""
    if len(rows) % 3:
        return False
    stack = rows.reshape(-1, 3, 3)
    return bool(np.abs(stack @ stack.transpose(0, 2, 1) - np.eye(3)).max() < ORTHOGONAL_OFF)


def _unit(rows: Array) -> bool:
    """True for quaternions, one in each row."""
    return rows.shape[1] == 4 and bool(np.abs(np.linalg.norm(rows, axis=1) - 1).max() < ORTHOGONAL_OFF)


def join_halves(halves: Sequence[Half]) -> list[Record]:
    """The poses of halves that belong together: rotation first for matrices, else position first."""
    turns, places = [h for h in halves if h.turns], [h for h in halves if not h.turns]
    records: list[Record] = []
    for turn in turns:
        near = [p for p in places if len(p.rows) == len(turn.rows) and p.path.parent == turn.path.parent]
        named = [p for p in near if p.rest == turn.rest]
        if len(named) != 1:
            alone = sum(len(t.rows) == len(turn.rows) for t in turns) == 1
            named = near if alone and len(near) == 1 else []
        if not named:
            continue
        place = named[0]
        field = f"{turn.field}+{place.field}" if place.path == turn.path else f"with {place.path.name}"
        wide = turn.rows.shape[1] == 9
        both = np.hstack([turn.rows, place.rows] if wide else [place.rows, turn.rows])
        kind = "rotation" if turn.rows.shape[1] == 3 else ""
        records += [Record(turn.path, field, f"[{k}]", row, kind) for k, row in enumerate(both)]
    return records
