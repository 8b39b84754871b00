"""What a picture shows of a board: which points, where, and how sure their order is.

The kinds of calibration boards and their names, such as `marked_dots:9x7:20mm` or `charuco:8x6:15mm`.

Board frame: origin at the first dot or inner corner, x along a row, y down the rows, z into the board."""

import re
from dataclasses import dataclass, replace
from typing import Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array
from drivers.errors import ConfigError

Kind = Literal["marked_dots", "asymmetric_dots", "dots", "chessboard", "charuco", "aprilgrid"]
KINDS: tuple[Kind, ...] = ("marked_dots", "asymmetric_dots", "dots", "chessboard", "charuco", "aprilgrid")
DOTS: tuple[Kind, ...] = ("marked_dots", "asymmetric_dots", "dots")

UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "um": 1e-6, "in": 25.4e-3}
FORM = "a board is named KIND:COLSxROWS:PITCH with the unit, such as chessboard:7x6:10mm"
# Markers are named by their side and dictionary behind the pitch.
MARKED: tuple[Kind, ...] = ("charuco", "aprilgrid")
# Tags are 1/1.3 of their pitch where nothing is said, the usual gap of 0.3 tags between them.
MARKER_SHARE = {"charuco": 0.7, "aprilgrid": 1 / 1.3}
FAMILIES = ("16h5", "25h9", "36h10", "36h11")
DEFAULT_DICTIONARY = {"charuco": "DICT_5X5_100", "aprilgrid": "DICT_APRILTAG_36h11"}
MOST_COLUMNS = 30
LEAST_FIT, FIT_SHARE = 6, 0.8
"""So many markers, and this share of all, have to lie as on the board that is proposed."""
NEAR = 0.25
"""… to this share of their side."""


@dataclass(frozen=True)
class BoardSpec:
    """A board: kind, columns and rows of its dots (inner corners; for ChArUco squares, else tags) and their pitch in m.

    `asymmetric_dots` follow OpenCV: dot (i, j) lies at ((2i + j mod 2)·pitch, j·pitch). `marked_dots` have a diameter
    of half a pitch and three rings, at (c, r), (c+2, r), (c, r+1) with c = (cols−1)//2, r = (rows−1)//2. An `aprilgrid`
    has tags of side `marker`, a pitch apart; its points are each tag's corners, clockwise from the upper left.
    """

    kind: Kind
    cols: int
    rows: int
    pitch: float
    marker: float = 0.0
    dictionary: str = "DICT_5X5_100"

    @property
    def name(self) -> str:
        """The board's name as `parse_board` reads it."""
        if self.single:
            return f"apriltag:{self.dictionary.removeprefix('DICT_APRILTAG_')}:{self.marker * 1e3:g}mm"
        name = f"{self.kind}:{self.cols}x{self.rows}:{self.pitch * 1e3:g}mm"
        if self.kind in MARKED:
            name += f":{self.marker * 1e3:g}mm:{self.dictionary}"
        return name

    @property
    def single(self) -> bool:
        """True for one tag by itself, whatever its number."""
        return self.kind == "aprilgrid" and self.cols == self.rows == 1

    @property
    def grid(self) -> tuple[int, int]:
        """Columns and rows of the points that are measured."""
        if self.kind == "aprilgrid":
            return (2 * self.cols, 2 * self.rows)
        return (self.cols - 1, self.rows - 1) if self.kind == "charuco" else (self.cols, self.rows)

    def lattice(self) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
        """Places (n, 2) of the points in whole pitches, rows one after the other: their order is the points' id. Of
        tags, four corners each, even places are their upper and left sides."""
        if self.kind == "aprilgrid":
            row, column = np.divmod(np.arange(self.cols * self.rows), self.cols)
            tag = 2 * np.column_stack([column, row])
            return np.asarray((tag[:, None, :] + [[0, 0], [1, 0], [1, 1], [0, 1]]).reshape(-1, 2), dtype=np.intp)
        cols, rows = self.grid
        j, i = np.divmod(np.arange(cols * rows), cols)
        x = 2 * i + j % 2 if self.kind == "asymmetric_dots" else i
        return np.column_stack([x, j])

    def points(self) -> Array:
        """The points (n, 3) in the board frame in m, in the order of `lattice`."""
        flat = self.lattice() * self.pitch
        if self.kind == "aprilgrid":
            whole, corner = np.divmod(self.lattice(), 2)
            flat = whole * self.pitch + corner * self.marker
        return np.column_stack([flat, np.zeros(len(flat))]).astype(np.float64)

    @property
    def dot_radius(self) -> float:
        """Radius of a dot in m where the kind of board fixes it, else 0 (corners, or dots of any size)."""
        return 0.25 * self.pitch if self.kind == "marked_dots" else 0.0

    @property
    def rings(self) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
        """Places (column, row) of the three rings of `marked_dots`."""
        c, r = (self.cols - 1) // 2, (self.rows - 1) // 2
        return ((c, r), (c + 2, r), (c, r + 1))

    @property
    def symmetric(self) -> bool:
        """True when the board turned by half a turn looks the same, so that a picture cannot tell its order."""
        if self.kind == "dots":
            return True
        if self.kind == "asymmetric_dots":
            return self.rows % 2 == 0
        return self.kind == "chessboard" and (self.cols + self.rows) % 2 == 0

    @property
    def orders(self) -> int:
        """How many orders of the points a picture cannot tell apart: 4 where a quarter turn looks the same as well."""
        square = self.cols == self.rows and (self.kind == "dots" or self.cols % 2 == 0)
        return 1 if not self.symmetric else 4 if square else 2


def parse_board(text: str, single_tag: bool = False) -> BoardSpec:
    """The board of a name; ConfigError says which part of the name is wrong and how it should look. With `single_tag`
    one AprilTag is a board, too, such as apriltag:36h11:50mm: its four corners are the points."""
    parts = text.strip().split(":")
    if single_tag and parts[0] == "apriltag":
        return _single_tag(text, parts)
    if len(parts) < 3:
        raise ConfigError(f"board {text!r} has {len(parts)} of at least 3 parts: {FORM}")
    kind = next((k for k in KINDS if k == parts[0]), None)
    if kind is None:
        raise ConfigError(f"board {text!r}: unknown kind {parts[0]!r}, allowed are {', '.join(KINDS)}: {FORM}")
    size = re.fullmatch(r"(\d{1,3})[x×](\d{1,3})", parts[1])
    if size is None:
        raise ConfigError(f"board {text!r}: {parts[1]!r} is no number of columns x rows: {FORM}")
    cols, rows = int(size[1]), int(size[2])
    least = {"marked_dots": (4, 3), "charuco": (3, 3), "aprilgrid": (2, 2)}.get(kind, (3, 2))
    if not (least[0] <= cols <= 100 and least[1] <= rows <= 100):
        raise ConfigError(f"board {text!r}: {kind} needs {least[0]}x{least[1]} to 100x100, not {cols}x{rows}")
    pitch = _length(text, parts[2], "pitch")
    if kind not in MARKED:
        if len(parts) > 3:
            raise ConfigError(f"board {text!r}: nothing may follow the pitch of a {kind} board: {FORM}")
        return BoardSpec(kind, cols, rows, pitch)
    marker, dictionary = MARKER_SHARE[kind] * pitch, DEFAULT_DICTIONARY[kind]
    for part in parts[3:]:
        if part.startswith("DICT_"):
            dictionary = part
        else:
            marker = _length(text, part, "marker size")
    if not hasattr(cv2.aruco, dictionary):
        raise ConfigError(
            f"board {text!r}: unknown marker dictionary {dictionary!r}, for example {DEFAULT_DICTIONARY[kind]}"
        )
    if not marker < pitch:
        raise ConfigError(f"board {text!r}: the marker ({marker * 1e3:g} mm) must be smaller than its pitch")
    return BoardSpec(kind, cols, rows, pitch=pitch, marker=marker, dictionary=dictionary)


def _single_tag(text: str, parts: list[str]) -> BoardSpec:
    if len(parts) != 3 or parts[1] not in FAMILIES:
        raise ConfigError(f"board {text!r}: a tag is named apriltag:FAMILY:SIDE with {', '.join(FAMILIES)}")
    side, dictionary = _length(text, parts[2], "side"), f"DICT_APRILTAG_{parts[1]}"
    return BoardSpec("aprilgrid", 1, 1, side / MARKER_SHARE["aprilgrid"], marker=side, dictionary=dictionary)


def _length(board: str, text: str, what: str) -> float:
    match = re.fullmatch(r"([0-9.]+(?:e-?\d+)?)\s*([a-zµ]+)?", text.strip())
    if match is None or match[2] is None or match[2].replace("µ", "u") not in UNITS_M:
        raise ConfigError(f"board {board!r}: the {what} {text!r} needs a number and a unit (mm, cm, m): {FORM}")
    try:
        metres = float(match[1]) * UNITS_M[match[2].replace("µ", "u")]
    except ValueError as error:
        raise ConfigError(f"board {board!r}: the {what} {text!r} is no length: {FORM}") from error
    if not 1e-4 <= metres <= 10.0:
        raise ConfigError(f"board {board!r}: the {what} {text!r} is outside 0.1 mm to 10 m")
    return metres


def centre_of(board: BoardSpec) -> Array:
    """The middle (3,) of the board's points in its own frame, m."""
    points = board.points()
    return np.asarray(0.5 * (points.min(axis=0) + points.max(axis=0)), dtype=np.float64)


def propose_counts(spec: BoardSpec, corners: Array, ids: NDArray[np.intp]) -> str:
    """A sentence with the counts that markers with corners (n, 4, 2) in px and ids (n,) have; empty where unknown."""
    if len(ids) < LEAST_FIT:
        return ""
    pixels = corners.mean(axis=1)
    side = float(np.median(np.linalg.norm(np.diff(corners, axis=1), axis=2)))
    found: list[tuple[int, int, int]] = []
    for cols in range(2, MOST_COLUMNS):
        for places in _places(spec, cols, int(ids.max()) + 1):
            at = places[ids].astype(np.float64)
            homography, inliers = cv2.findHomography(at, pixels, cv2.RANSAC, max(1.0, NEAR * side))
            if homography is not None:
                found.append((int(inliers.sum()), cols, int(places[:, 1].max()) + 1))
    fit, cols, rows = max(found, default=(0, 0, 0), key=lambda f: f[0])
    if fit < max(LEAST_FIT, FIT_SHARE * len(ids)):
        return ""
    return f" By the markers read it has {cols}x{rows}: name those counts (more rows where the last are not in view)"


def _places(spec: BoardSpec, cols: int, count: int) -> list[NDArray[np.intp]]:
    """Column and row (count, 2) of each marker: all fields of a grid of tags, the white ones of a ChArUco board."""
    row, column = np.divmod(np.arange(2 * count + 2 * cols), cols)
    every = np.column_stack([column, row])
    if spec.kind == "aprilgrid":
        return [every[:count]]
    return [every[(column + row) % 2 == parity][:count] for parity in (1, 0)]


@dataclass(frozen=True, eq=False)
class BoardView:
    """The points of a board that were found in a picture of `size` (width, height) px.

    `ids` (n,) are indices into `spec.points()`, `pixels` (n, 2) the points' places, for dots the centres of their
    ellipses, `sigma` (n,) one standard deviation of each in px. `order_assumed` is True when the board looks the same
    turned by a half or a quarter turn: the order then rests on the set-up (first point towards the upper left of the
    picture), and `turns` gives the others. `dot_radius` is that of the dots in m, 0 for corners.
    """

    spec: BoardSpec
    size: tuple[int, int]
    ids: NDArray[np.intp]
    pixels: Array
    sigma: Array
    order_assumed: bool = False
    dot_radius: float = 0.0

    @property
    def object_points(self) -> Array:
        """The points (n, 3) in the board frame in m, in the order of `ids`."""
        return self.spec.points()[self.ids]

    def turns(self) -> list[Self]:
        """This view and those with the other orders that the board's symmetry allows."""
        if not self.order_assumed:
            return [self]
        lattice = self.spec.lattice()
        views = []
        for turn in range(0, 4, 4 // self.spec.orders):
            places = {tuple(p): k for k, p in enumerate(turned_places(lattice, turn))}
            views.append(replace(self, ids=np.array([places[tuple(p)] for p in lattice])[self.ids]))
        return views


def turned_places(places: NDArray[np.intp], quarters: int) -> NDArray[np.intp]:
    """Lattice places (n, 2) turned by quarter turns and moved back to start at (0, 0)."""
    turned = places
    for _ in range(quarters % 4):
        turned = np.column_stack([-turned[:, 1], turned[:, 0]])
    return np.asarray(turned - turned.min(axis=0), dtype=np.intp)
