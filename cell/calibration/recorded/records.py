"""What a text file holds for a calibration: numbers that may be a pose, by what they are named, and links to files."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cell.geometry.camera import Array

if TYPE_CHECKING:
    from cell.calibration.recorded.halves import Half

# Numbers of a pose: 6, 7, 3×4, 4×4; one more in front is a time or a number.
COUNTS = (6, 7, 12, 16)
# What a column of a position may begin with, and what those of a rotation are called.
PREFIXES = ("", "t", "p", "pos", "trans", "translation", "position", "tcp", "flange", "robot", "pose")
TURNS = (
    (("qx", "qy", "qz", "qw"), "quaternion"),
    (("x", "y", "z", "w"), "quaternion"),
    (("rx", "ry", "rz"), "rotation"),
    (("roll", "pitch", "yaw"), "rotation"),
    (("a", "b", "c"), "rotation"),
    (("w", "p", "r"), "rotation"),
)


@dataclass(frozen=True, eq=False)
class Record:
    """Numbers (n,) that may be a pose; `field` is their place in the file, `label` the picture or number they name.

    `named`: "quaternion" (x, y, z, qx, qy, qz, qw) or "rotation" (x, y, z, then three angles) where names said so.
    """

    path: Path
    field: str
    label: str | None
    numbers: Array
    named: str = ""
    time: float | None = None
    exact: str = ""
    """Its place with the numbers in the names that `field` leaves out, where that is another."""


@dataclass
class Content:
    """What a text holds: records, halves of them, and links between files (picture, or name of the other, file)."""

    records: list[Record] = field(default_factory=list)
    links: list[dict[str, str]] = field(default_factory=list)
    halves: list[Half] = field(default_factory=list)


def named_numbers(names: list[str], values: list[Any]) -> tuple[Array | None, str]:
    """A pose of columns or keys such as x y z qx qy qz qw, x y z rx ry rz, in any order, others beside."""
    clean = [re.sub(r"\(.*?\)|\[.*?\]|_?(?:mm|deg|rad|m)$|[^a-z]", "", n.lower()) for n in names]
    for prefix in PREFIXES:
        place = [clean.index(prefix + a) if prefix + a in clean else -1 for a in "xyz"]
        if min(place) < 0:
            continue
        for turn, kind in TURNS:
            where = [clean.index(t) if t in clean else -1 for t in turn]
            if min(where) < 0:
                where = [clean.index(prefix + t) if prefix + t in clean else -1 for t in turn]
            if min(where) >= 0 and not (turn[0] == "x" and prefix == ""):
                return np.array([values[k] for k in (*place, *where)], dtype=np.float64), kind
    numbered = [re.sub(r"[^a-z0-9]", "", n.lower()) for n in names]
    for name in ("pose", "actualtcppose"):
        for first in (0, 1):
            six = [numbered.index(n) if (n := f"{name}{k}") in numbered else -1 for k in range(first, first + 6)]
            if min(six) >= 0 and f"{name}{first + 6}" not in numbered:
                return np.array([values[k] for k in six], dtype=np.float64), ""
    return None, ""


def file_like(word: str) -> bool:
    """True for a word that ends as a file's name does."""
    return re.search(r"\.[A-Za-z]{2,5}$", word) is not None
