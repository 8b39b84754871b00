"""From a text file to its records of numbers: JSON, YAML, XML, Python tuples, numpy arrays, an arm's program, tables.

Which numbers mean what is not decided here (`conventions.py`); only names that say it themselves are kept.
"""

import ast
import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Self
from xml.etree import ElementTree

import numpy as np
import yaml

from cell.measure.geometry.camera import Array

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
STRUCTURED = (".json", ".yaml", ".yml", ".xml")
COUNTS = (6, 7, 12, 16)
"""Numbers of a pose: 6, 7, 3×4, 4×4; one more in front is a time or a number."""
NEEDED = "a pose has 6, 7, 12 or 16"
ORTHOGONAL_OFF, UNIT_OFF = 0.02, 0.02
"""Matrices and quaternions are written with few digits at times."""
LARGEST_NUMBER = 1e6
"""What stands in front of a pose and is larger is a time and no picture's number."""
LEAST_HALVES, LONGEST = 3, 8
"""Rows of a half; lines of one pose."""
NUMBER = re.compile(
    r"(?<![\w.])(?:[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?(?![\w.:])|[-+]?(?:nan|inf)(?!\w))", re.IGNORECASE
)
# A pose that a program of a UR arm moves to: position and rotation vector.
MOVE = re.compile(r"\bmove[a-z]+\s*\(\s*p\s*\[([^\]]*)\]")
# What a column of a position may begin with, and what those of a rotation are called.
PREFIXES = ("", "t", "p", "pos", "trans", "translation", "position", "tcp", "flange", "robot", "pose")
TURNS = (("qx", "qy", "qz", "qw"), ("x", "y", "z", "w"), ("rx", "ry", "rz"), ("roll", "pitch", "yaw"), ("a", "b", "c"))
NAMED_COLUMNS = [
    ([prefix + axis for axis in "xyz"] + [before + name for name in turn], len(turn))
    for prefix in PREFIXES
    for turn in TURNS
    for before in ("", prefix)
    if prefix + before or turn != TURNS[1]
]
POSITIONS = ("position", "translation", "t", "trans", "tvec", "pos", "xyz")
ROTATIONS = ("orientation", "rotation", "quaternion", "quat", "q", "r", "rot", "rvec", "rpy")
TIMING = re.compile(r"time|stamp|t$|sec")
NUMBERING = re.compile(r"id|index|frame|image|file|name|no\b|num|^n$|pic")
HALVES = re.compile(
    r"r|rot|rotations?|rmats?|rvecs?|rotvecs?|q|quats?|quaternions?|(t|trans|translations?|tvecs?|pos|positions?|xyz|p)"
)
"""What the two halves of poses are called; the second are the positions."""


@dataclass(frozen=True, eq=False)
class PoseRecord:
    """Numbers (n,) that may be a pose; `field` is their place in the file, `label` the picture or number they name.

    `named`: "quaternion" (x, y, z, qx, qy, qz, qw) or "rotation" (x, y, z, then three angles) where names said so.
    `exact`: its place with the numbers in the names that `field` leaves out. `time`: of the pose, where it has one.
    """

    path: Path
    field: str
    label: str | None
    numbers: Array
    named: str = ""
    exact: str = ""
    time: float | None = None


@dataclass
class Content:
    """What a text holds: records, halves of them, and links between files (picture, or name of the other, file). Halves
    are rotations (n, 9), (n, 4) or (n, 3), or positions (n, 3), with their place in the file."""

    path: Path
    records: list[PoseRecord] = field(default_factory=list)
    links: list[dict[str, str]] = field(default_factory=list)
    halves: list[tuple[Path, str, Array]] = field(default_factory=list)

    def walk(self, data: Any, place: Sequence[str] = (), label: str | None = None) -> None:
        """Find the poses and the links in nested maps and lists."""
        if isinstance(data, dict):
            strings = {str(k): v for k, v in data.items() if isinstance(v, str)}
            if sum(map(_file_like, strings.values())) > 1:
                self.links.append(strings)
            label = next((v for v in strings.values() if _is_picture(v)), label)
            array, (found, named) = stored_matrix(data), _by_names(data)
            if array is not None:
                self._take(array, place, label)
            elif found is not None:
                self._add(found, place, label, named)
            else:
                for key, value in data.items():
                    self.walk(value, [*place, str(key)], label)
        elif isinstance(data, (list, tuple)) and len(data):
            array = _array(data)
            if array is not None:
                self._take(array, place, label)
            else:
                for k, value in enumerate(data):
                    self.walk(value, [*place, f"[{k}]"], label)

    def _take(self, array: Array, place: Sequence[str], label: str | None) -> None:
        if _is_pose(array):
            self._add(array.ravel(), place, label)
        elif array.ndim >= 2 and _is_pose(array[0]):
            timed = array.shape[1:] == (7,) and _timed(array.tolist())
            for k, part in enumerate(array):
                self._add(part.ravel(), [*place, f"[{k}]"], f"[{k}]", timed=timed)
        elif (rows := _half_of(array)) is not None:
            self.halves.append((self.path, "/".join(place), rows))

    def _add(
        self, numbers: Array, place: Sequence[str], label: str | None, named: str = "", *, timed: bool = False
    ) -> None:
        label = label or next((part for part in reversed(place) if re.search(r"\d", part)), None)
        pattern = "/".join(re.sub(r"\d+", "N", part) for part in place)
        exact = "/".join(re.sub(r"\[\d+\]", "[N]", part) for part in place)
        time = float(numbers[0]) if timed or len(numbers) not in COUNTS else None
        pose = _squared(numbers if time is None else numbers[1:])
        self.records.append(PoseRecord(self.path, pattern, label, pose, named=named, exact=exact, time=time))


def read_content(path: Path) -> Content:
    """Records and links of a file. Raises ValueError that says what is wrong with it."""
    content, suffix = Content(path), path.suffix.lower()
    if suffix in (".npy", ".npz"):
        loaded = np.load(path, allow_pickle=False)
        content.walk(loaded.tolist() if isinstance(loaded, np.ndarray) else {k: v.tolist() for k, v in loaded.items()})
        return content
    # As numpy prints its numbers and arrays.
    text = re.sub(r"(?:np\.|numpy\.)?(?:float\d+|array)\(([^()]*)\)", r"\1", decoded(path.read_bytes()))
    if not text.strip():
        raise ValueError("it is empty")
    if text.startswith("version https://git-lfs"):
        raise ValueError("it only points to a file that was not fetched (Git LFS)")
    content.walk(structured(suffix, text))
    if suffix not in STRUCTURED and not (content.records or content.links or content.halves):
        moves = [[float(value) for value in found.split(",")] for found in MOVE.findall(text)]
        content.records += [
            PoseRecord(path, "row", f"[{k}]", np.array(m), "rotation") for k, m in enumerate(moves) if len(m) == 6
        ]
        if not content.records:
            _read_table(text, content)
    return content


def decoded(data: bytes) -> str:
    """The text of a file in UTF-8, UTF-16 with a mark, or Latin-1; a minus sign of print is one."""
    try:
        return data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig").replace("\u2212", "-")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def structured(suffix: str, text: str) -> Any:
    """The object of a JSON, YAML, XML or Python text; None for a plain table. Raises ValueError."""
    start = text.lstrip()
    if suffix == ".json":
        try:
            return json.loads(text)
        except ValueError as error:
            raise ValueError(f"it is no JSON: {error}") from error
    if suffix in (".yaml", ".yml") or text.startswith("%YAML"):
        return _yaml(text)
    if suffix == ".xml":
        if "<!ENTITY" in text or "<!DOCTYPE" in text:
            raise ValueError("it is more of XML than is read here (entities)")
        try:
            root = ElementTree.fromstring(re.sub(r"^\s*<\?xml[^>]*\?>", "", text))
        except ElementTree.ParseError as error:
            raise ValueError(f"it is no XML: {error}") from error
        return {root.tag: _element(root)}
    if start[:1] in ("(", "[", "{"):
        for read in (ast.literal_eval, json.loads):
            with suppress(ValueError, SyntaxError):
                return read(text.strip())
    if re.match(r"(?:---\s+)?\w+:\s", start):
        # As rostopic prints messages.
        with suppress(ValueError):
            return _yaml(text)
    return None


def _yaml(text: str) -> Any:
    """The object of a YAML text whatever its tags say, a list of those of its documents. Raises ValueError."""
    if re.search(r"(?m)(?:^|[\s\[,])\*\w+\s*(?:[\],]|$)", text):
        raise ValueError("it is YAML with aliases: write the values out")
    loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
    try:
        # OpenCV's first line is none of YAML's, and its values may follow their tag on the next line.
        found = list(yaml.load_all(re.sub(r"\A%YAML.*\n(?:---)?", "", text).expandtabs(4), loader))
    except yaml.YAMLError as error:
        raise ValueError(f"it is no YAML: {' '.join(str(error).split())[:160]}") from error
    found = [_numbered(document) for document in found if document]
    return found if len(found) > 1 else found[0] if found else None


def _numbered(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _numbered(value) for key, value in data.items()}
    return list(map(_numbered, data)) if isinstance(data, list) else _scalar(data)


def _scalar(word: str) -> float | str:
    try:
        return float(re.sub(r"\.(?=nan|inf)", "", word, flags=re.IGNORECASE))
    except ValueError:
        return word.strip()


def _of_text(text: str) -> Any:
    words = [_scalar(word) for word in text.split()]
    return words if len(words) > 1 and not any(isinstance(word, str) for word in words) else _scalar(text)


def _element(element: ElementTree.Element) -> Any:
    """An XML element as a map, list, number or word; elements of one name are a list."""
    text = element.text or ""
    parts: dict[str, list[Any]] = {key: [_of_text(value)] for key, value in element.attrib.items()}
    for child in element:
        parts.setdefault(child.tag, []).append(_element(child))
    # An attribute beside a text says what the text is (type_id); beside none it is what the element holds.
    if parts and (len(element) or not text.strip()):
        return {key: values[0] if len(values) == 1 else values for key, values in parts.items()}
    return _of_text(text)


def _is_pose(array: Array) -> bool:
    counts = (*COUNTS, *(n + 1 for n in COUNTS))
    return array.shape in ((4, 4), (3, 4)) or (array.size in counts and max(array.shape, default=0) == array.size)


def _array(data: Any) -> Array | None:
    """Numbers of a list, the two parts of ((x, y, z), (…)) one behind the other; None where words are among them."""
    with suppress(TypeError, ValueError):
        return np.asarray(data, dtype=np.float64)
    try:
        parts = [np.ravel(np.asarray(part, dtype=np.float64)) for part in data]
    except (TypeError, ValueError):
        return None
    return np.concatenate(parts) if len(parts) == 2 and len(parts[0]) in (3, 4) else None


def _squared(numbers: Array) -> Array:
    """A 3×4 matrix, or a 3×3 and a position, as the 4×4 (16,); other numbers as they are."""
    if len(numbers) != 12:
        return numbers
    for rows in (numbers.reshape(3, 4), np.column_stack([numbers[:9].reshape(3, 3), numbers[9:]])):
        if not np.isfinite(numbers).all() or np.abs(rows[:, :3] @ rows[:, :3].T - np.eye(3)).max() < ORTHOGONAL_OFF:
            return np.append(rows.ravel(), (0.0, 0.0, 0.0, 1.0))
    return numbers


def _by_names(data: dict[Any, Any]) -> tuple[Array | None, str]:
    """A pose of a map whose keys say what is what."""
    low = {re.sub(r"[^a-z0-9]", "", str(k).lower()): v for k, v in data.items()}
    (position, _), (turn, named) = _part(low, POSITIONS), _part(low, ROTATIONS)
    if position is not None and turn is not None and len(position) == 3:
        if len(turn) in (3, 4):
            return np.concatenate([position, turn]), named
        if len(turn) == 9:
            return _squared(np.concatenate([turn, position])), ""
    values = {k: v for k, v in low.items() if isinstance(v, (int, float))}
    return _named_numbers(list(values), list(values.values()))


def _part(low: dict[str, Any], keys: tuple[str, ...]) -> tuple[Array | None, str]:
    value = next((low[k] for k in keys if k in low), None)
    array, named = _array(value) if isinstance(value, (list, tuple)) else None, ""
    if isinstance(value, dict):
        inner = {str(k).lower().lstrip("q"): v for k, v in value.items()}
        names = "xyzw" if set(inner) == set("xyzw") else "xyz"
        array = _array([inner[n] for n in names]) if set(inner) == set(names) else stored_matrix(value)
        named = "quaternion" if names == "xyzw" else ""
    return None if array is None else array.ravel(), named


def stored_matrix(data: dict[Any, Any]) -> Array | None:
    """The matrix of a map of rows, cols and data, as OpenCV stores it; its elements may have several channels."""
    array, shape = _array(data.get("data")), (data.get("rows"), data.get("cols"))
    if array is None or not all(isinstance(n, (int, float)) and n >= 1 and n == int(n) for n in shape):
        return None
    rows, columns = (int(n) for n in shape if n is not None)
    if array.ndim == 0 or array.size % (rows * columns):
        return None
    return array.reshape((rows, columns) if array.size == rows * columns else (rows, columns, -1))


def _named_numbers(names: Sequence[str], values: Sequence[Any]) -> tuple[Array | None, str]:
    """A pose of columns or keys such as x y z qx qy qz qw, x y z rx ry rz, in any order, others beside."""
    clean = [re.sub(r"\(.*?\)|\[.*?\]|_?(?:mm|deg|rad|m)$|[^a-z]", "", n.lower()) for n in names]
    for wanted, turns in NAMED_COLUMNS:
        if set(wanted) <= set(clean):
            found = np.array([values[clean.index(n)] for n in wanted], dtype=np.float64)
            return found, "quaternion" if turns == 4 else "rotation"
    numbered = [re.sub(r"[^a-z0-9]", "", n.lower()) for n in names]
    for name, first in (("pose", 0), ("pose", 1), ("actualtcppose", 0), ("actualtcppose", 1)):
        six = [f"{name}{k + first}" for k in range(6)]
        if set(six) <= set(numbered) and f"{name}{6 + first}" not in numbered:
            return np.array([values[numbered.index(n)] for n in six], dtype=np.float64), ""
    return None, ""


def _file_like(word: str) -> bool:
    return re.search(r"\.[A-Za-z]{2,5}$", word) is not None


def _is_picture(word: str) -> bool:
    return Path(word).suffix.lower() in PICTURES


class _TableLine(NamedTuple):
    """A line of a table: its cells, its numbers, and the words beside these."""

    cells: list[str]
    numbers: list[float]
    words: list[str]

    @classmethod
    def of(cls, text: str) -> Self:
        separator = r"[;\t]" if re.search(r"[;\t]", text) else "," if "," in text else r"\s+"
        cells = [cell.strip().strip("\"'") for cell in re.split(separator, text)]
        words = [word for word in re.split(r"[\s,;=()\[\]{}\"']+", NUMBER.sub(" ", text)) if word]
        return cls(cells, [float(number) for number in NUMBER.findall(text)], words)


def _read_table(text: str, content: Content) -> None:
    """Add the records of a table: a pose in each line, over several lines, or rotations and positions by themselves."""
    header, lines = _table_lines(text)
    for line in lines:
        files = [word for word in line.words if _file_like(word)]
        if len(files) > 1:
            content.links.append({str(k): file for k, file in enumerate(files)})
    if (half := _half_of_table(lines)) is not None:
        content.halves.append((content.path, "", half))
        return
    length = _lines_of_a_pose(lines)
    if not length and not content.links:
        raise ValueError(f"it holds {sum(len(line.numbers) for line in lines)} numbers; {NEEDED}")
    blocks = [lines[k : k + length] for k in range(0, len(lines), length)] if length else []
    timed = _timed([numbers for block in blocks if len(numbers := _numbers_of(block)) == 7])
    for k, block in enumerate(blocks):
        if _numbers_of(block):
            content.records.append(_table_record(content.path, k, block, header, timed))


def _table_lines(text: str) -> tuple[list[str], list[_TableLine]]:
    """The cells of a table's header, if it has one, and its other lines without comments."""
    kept = [line.strip() for line in text.splitlines() if line.strip() and line.strip()[0] not in "#%"]
    # Commas between digits are decimal commas where something else separates, or quotes hold them.
    kept = [re.sub(r'"(-?\d*),(\d+)"', r"\1.\2", line) for line in kept]
    decimal = re.compile(r".*[;\t].*|([^,]*\s)?-?\d*,\d+(\s+-?\d*,\d+)+")
    lines = [_TableLine.of(re.sub(r"(?<=\d),(?=\d)", ".", line) if decimal.fullmatch(line) else line) for line in kept]
    if len(lines) > 1 and not lines[0].numbers and max(len(line.numbers) for line in lines[1:]) >= min(COUNTS):
        return lines[0].cells, lines[1:]
    return [], lines


def _half_of_table(lines: Sequence[_TableLine]) -> Array | None:
    """The rows of a table that holds nothing but rotations or positions; else None."""
    rows = [line.numbers for line in lines]
    even = len(set(map(len, rows))) == 1 and not any(line.words for line in lines)
    return _half_of(np.array(rows)) if even and len(rows[0]) < min(COUNTS) else None


def _timed(seven: Sequence[list[float]]) -> bool:
    """Whether of seven numbers the first is a time, because no four of them are a quaternion."""
    rows = np.array(seven).reshape(-1, 7)
    rows = rows[np.isfinite(rows).all(axis=1)]
    quaternions = (rows[:, 3:], rows[:, :4])
    return len(rows) > 0 and all(np.abs(np.linalg.norm(q, axis=1) - 1).max() >= UNIT_OFF for q in quaternions)


def _lines_of_a_pose(lines: Sequence[_TableLine]) -> int:
    """How many lines hold a pose: the shortest pattern of lines that repeats, mostly four; 0 where none does."""
    if max((len(line.numbers) for line in lines), default=0) >= min(COUNTS):
        return 1
    patterns = [(len(line.numbers), bool(line.words)) for line in lines]
    lengths = sorted({*range(1, min(LONGEST, len(lines)) + 1), len(lines)} - {0}, key=lambda n: n != 4)
    repeating = (n for n in lengths if patterns == patterns[:n] * (len(patterns) // n))
    return next((n for n in repeating if len(_numbers_of(lines[:n])) in COUNTS), 0)


def _table_record(path: Path, k: int, block: Sequence[_TableLine], header: Sequence[str], timed: bool) -> PoseRecord:
    """The record of the lines of one pose; `timed`: of seven numbers the first is a time. Raises ValueError."""
    words, cells = [word.strip(":=") for line in block for word in line.words], block[0].cells
    label = [*filter(_is_picture, words), *filter(re.compile(r"\d").search, [] if header else words), ""][0]
    pose, named, number, time = _by_header(header, cells)
    if pose is not None:
        return PoseRecord(path, "row", label or number or f"[{k}]", pose, named, time=time)
    found = _numbers_of(block)
    if len(found) - 1 in COUNTS and (len(found) != 7 or timed):
        time, found = found[0], found[1:]
        label = label or (f"{time:.0f}" if abs(time) < LARGEST_NUMBER and time == int(time) else "")
    if len(found) not in COUNTS:
        raise ValueError(f"line {k + 1} of its table holds {len(found)} numbers; {NEEDED}")
    return PoseRecord(path, "row", label or f"[{k}]", _squared(np.array(found)), time=time)


def _by_header(header: Sequence[str], cells: Sequence[str]) -> tuple[Array | None, str, str, float | None]:
    """The pose that a row's columns name, how they name its rotation, and the row's number and time."""
    if len(cells) != len(header):
        return None, "", "", None
    values = [float(cell) if NUMBER.fullmatch(cell) else np.nan for cell in cells]
    numbers = (cell for name, cell in zip(header, cells, strict=True) if NUMBERING.search(name.lower()))
    times = (value for name, value in zip(header, values, strict=True) if TIMING.match(name.lower()))
    return *_named_numbers(header, values), next(numbers, ""), next(times, None)


def _numbers_of(block: Sequence[_TableLine]) -> list[float]:
    """The numbers of a pose: no number or time in its title, no angles that only say again what a quaternion says."""
    several = any(len(line.numbers) > 1 for line in block)
    parts = [line for line in block if len(line.numbers) > 1 or not several]
    if any(len(line.numbers) == 4 for line in parts) and len(parts) > 2:
        parts = [line for line in parts if not re.search(r"\brpy\b|euler", " ".join(line.words).lower())]
    said = " ".join(word for line in block for word in line.words).lower()
    if len(parts) == 2 and re.search(r"(rotation|orientation|quat).*(translation|position)", said):
        parts.reverse()
    return [value for line in parts for value in line.numbers]


def _half_of(array: Array) -> Array | None:
    """The rows of an array that is one half of at least three poses, or None."""
    if not np.isfinite(array).all() or array.ndim not in (2, 3):
        return None
    rows = array.reshape(len(array), -1)
    square = array.size % 9 == 0 and (array.shape[-1] == 3 or rows.shape[1] == 9)
    stack = array.reshape(-1, 3, 3) if square else np.zeros((0, 3, 3))
    matrices = bool(len(stack)) and np.abs(stack @ stack.transpose(0, 2, 1) - np.eye(3)).max() < ORTHOGONAL_OFF
    rows = stack.reshape(-1, 9) if matrices else rows
    unit = rows.shape[1] == 4 and np.abs(np.linalg.norm(rows, axis=1) - 1).max() < UNIT_OFF
    return rows if len(rows) >= LEAST_HALVES and (matrices or unit or rows.shape[1] == 3) else None


class _Half(NamedTuple):
    """One half of poses: where its rows (n, …) are, and the words of its name that do not say which half it is."""

    path: Path
    where: str
    rows: Array
    rest: list[str]
    turns: bool

    @classmethod
    def of(cls, path: Path, where: str, rows: Array) -> Self:
        words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", f"{path.stem} {where}").lower())
        roles = [found for word in words if (found := HALVES.fullmatch(word))]
        turns = rows.shape[1] != 3 or (bool(roles) and not any(found[1] for found in roles))
        return cls(path, where, rows, [word for word in words if not HALVES.fullmatch(word)], turns)


def join_halves(found: Sequence[tuple[Path, str, Array]]) -> tuple[list[PoseRecord], set[Path]]:
    """The poses of halves that belong together by their names or are the only two, and the files they were in."""
    halves = [_Half.of(*one) for one in found]
    records: list[PoseRecord] = []
    used: set[Path] = set()
    for turn in (half for half in halves if half.turns):
        place = _other_half(turn, [half for half in halves if len(half.rows) == len(turn.rows)])
        if place is None:
            continue
        width = turn.rows.shape[1]
        both = np.hstack([turn.rows, place.rows] if width == 9 else [place.rows, turn.rows])
        where, said = f"{turn.where}+{place.where}" if turn.where else "row", "rotation" if width == 3 else ""
        records += [PoseRecord(turn.path, where, f"[{k}]", _squared(row), said) for k, row in enumerate(both)]
        used |= {turn.path, place.path}
    return records, used


def _other_half(turn: _Half, alike: Sequence[_Half]) -> _Half | None:
    """The positions of rotations, of halves with as many rows: those with the same name, or the only ones."""
    near = [half for half in alike if not half.turns and half.path.parent == turn.path.parent]
    named = [half for half in near if half.rest == turn.rest]
    if len(named) != 1 and sum(half.turns for half in alike) == 1:
        named = near
    return named[0] if len(named) == 1 else None
