"""From a text file to its records of numbers: JSON, YAML, XML, Python tuples, numpy arrays, an arm's program, tables.

Which numbers mean what is not decided here (`conventions.py`); only names that say it themselves are kept.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
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
POSITIONS = ("position", "translation", "t", "trans", "tvec", "pos", "xyz")
ROTATIONS = ("orientation", "rotation", "quaternion", "quat", "q", "r", "rot", "rvec", "rpy")
NUMBERING = re.compile(r"id|index|frame|image|file|name|no\b|num|^n$|pic")
HALVES = re.compile(
    r"r|rot|rotations?|rmats?|rvecs?|rotvecs?|q|quats?|quaternions?|(t|trans|translations?|tvecs?|pos|positions?|xyz|p)"
)
"""What the two halves of poses are called; the second are the positions."""


@dataclass(frozen=True, eq=False)
class PoseRecord:
    """Numbers (n,) that may be a pose; `field` is their place in the file, `label` the picture or number they name.

    `named`: "quaternion" (x, y, z, qx, qy, qz, qw) or "rotation" (x, y, z, then three angles) where names said so.
    `exact`: its place with the numbers in the names that `field` leaves out.
    """

    path: Path
    field: str
    label: str | None
    numbers: Array
    named: str = ""
    time: float | None = None
    exact: str = ""


@dataclass
class Content:
    """What a text holds: records, halves of them, and links between files (picture, or name of the other, file).

    Halves are rotations (n, 9), (n, 4) or (n, 3), or positions (n, 3), with their place in the file.
    """

    records: list[PoseRecord] = field(default_factory=list)
    links: list[dict[str, str]] = field(default_factory=list)
    halves: list[tuple[Path, str, Array]] = field(default_factory=list)


def read_content(path: Path) -> Content:
    """Records and links of a file. Raises ValueError that says what is wrong with it."""
    content, suffix = Content(), path.suffix.lower()
    if suffix in (".npy", ".npz"):
        loaded = np.load(path, allow_pickle=False)
        data = loaded.tolist() if isinstance(loaded, np.ndarray) else {k: v.tolist() for k, v in loaded.items()}
        _walk(path, data, [], None, content)
        return content
    # As numpy prints its numbers and arrays.
    text = re.sub(r"(?:np\.|numpy\.)?(?:float\d+|array)\(([^()]*)\)", r"\1", decoded(path.read_bytes()))
    if not text.strip():
        raise ValueError("it is empty")
    if text.startswith("version https://git-lfs"):
        raise ValueError("it only points to a file that was not fetched (Git LFS)")
    data = structured(suffix, text)
    if data is not None:
        _walk(path, data, [], None, content)
    if suffix not in STRUCTURED and not (content.records or content.links or content.halves):
        moves = [[float(v) for v in found.split(",")] for found in MOVE.findall(text)]
        content.records += [
            PoseRecord(path, "row", f"[{k}]", np.array(m), "rotation") for k, m in enumerate(moves) if len(m) == 6
        ]
        if not content.records:
            _read_table(path, text, content)
    return content


def decoded(data: bytes) -> str:
    """The text of a file in UTF-8, UTF-16 with a mark, or Latin-1."""
    try:
        return data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
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


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Plain maps, lists, numbers and words, whatever their tags say; 1e-3 is a number."""


def _plain(loader: _Loader, _: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else node.value


_Loader.add_multi_constructor("", _plain)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)[eE][-+]?\d+|[-+]?\.Nan"), list("-+.0123456789")
)


def _yaml(text: str) -> Any:
    """The object of a YAML text, a list of those of its documents. Raises ValueError."""
    if re.search(r"(?m)(?:^|[\s\[,])\*\w+\s*(?:[\],]|$)", text):
        raise ValueError("it is YAML with aliases: write the values out")
    try:
        # OpenCV's first line is none of YAML's, and its values may follow their tag on the next line.
        found = list(yaml.load_all(re.sub(r"\A%YAML.*\n(?:---)?", "", text).expandtabs(4), _Loader))
    except yaml.YAMLError as error:
        raise ValueError(f"it is no YAML: {' '.join(str(error).split())[:160]}") from error
    found = [document for document in found if document is not None]
    return found if len(found) > 1 else found[0] if found else None


def _element(element: ElementTree.Element) -> Any:
    """An XML element as a map, list, number or word; elements of one name are a list."""

    def scalar(text: str) -> Any:
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            return text.strip()
        return numbers[0] if len(numbers) == 1 else numbers or text.strip()

    parts: dict[str, list[Any]] = {key: [scalar(value)] for key, value in element.attrib.items()}
    for child in element:
        parts.setdefault(child.tag, []).append(_element(child))
    # An attribute beside a text says what the text is (type_id); beside none it is what the element holds.
    if parts and (len(element) or not (element.text or "").strip()):
        return {key: values[0] if len(values) == 1 else values for key, values in parts.items()}
    return scalar(element.text or "")


def _walk(path: Path, data: Any, place: list[str], label: str | None, content: Content) -> None:
    """Find the poses and the links in nested maps and lists."""
    if isinstance(data, dict):
        strings = {str(k): v for k, v in data.items() if isinstance(v, str)}
        if sum(map(_file_like, strings.values())) > 1:
            content.links.append(strings)
        label = next((v for v in strings.values() if Path(v).suffix.lower() in PICTURES), label)
        array, (found, named) = stored_matrix(data), _by_names(data)
        if array is not None:
            _take(path, array, place, label, content)
        elif found is not None:
            content.records.append(_record(path, place, label, found, named))
        else:
            for key, value in data.items():
                _walk(path, value, [*place, str(key)], label, content)
    elif isinstance(data, (list, tuple)) and len(data):
        array = _array(data)
        if array is not None:
            _take(path, array, place, label, content)
        else:
            for k, value in enumerate(data):
                _walk(path, value, [*place, f"[{k}]"], label, content)


def _take(path: Path, array: Array, place: list[str], label: str | None, content: Content) -> None:
    """Add the pose, the poses or the halves of poses that an array holds."""
    if _is_pose(array):
        content.records.append(_record(path, place, label, array.ravel()))
    elif array.ndim >= 2 and _is_pose(array[0]):
        content.records += [_record(path, [*place, f"[{k}]"], f"[{k}]", part.ravel()) for k, part in enumerate(array)]
    elif (rows := _half_of(array)) is not None:
        content.halves.append((path, "/".join(place), rows))


def _is_pose(array: Array) -> bool:
    counts = (*COUNTS, *(n + 1 for n in COUNTS))
    return array.shape in ((4, 4), (3, 4)) or (array.size in counts and max(array.shape, default=0) == array.size)


def _record(path: Path, place: list[str], label: str | None, numbers: Array, named: str = "") -> PoseRecord:
    label = label or next((p for p in reversed(place) if re.search(r"\d", p)), None)
    pattern, exact = ("/".join(re.sub(old, new, p) for p in place) for old, new in ((r"\d+", "N"), (r"\[\d+\]", "[N]")))
    time = float(numbers[0]) if len(numbers) not in COUNTS else None
    return PoseRecord(
        path, pattern, label, _squared(numbers if time is None else numbers[1:]), named=named, time=time, exact=exact
    )


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


def _named_numbers(names: list[str], values: list[Any]) -> tuple[Array | None, str]:
    """A pose of columns or keys such as x y z qx qy qz qw, x y z rx ry rz, in any order, others beside."""
    clean = [re.sub(r"\(.*?\)|\[.*?\]|_?(?:mm|deg|rad|m)$|[^a-z]", "", n.lower()) for n in names]
    numbered = [re.sub(r"[^a-z0-9]", "", n.lower()) for n in names]
    for prefix in PREFIXES:
        for turn in TURNS:
            for before in ("", prefix):
                wanted = [prefix + a for a in "xyz"] + [before + t for t in turn]
                if set(wanted) <= set(clean) and len(set(wanted)) == len(wanted):
                    found = np.array([values[clean.index(n)] for n in wanted], dtype=np.float64)
                    return found, "quaternion" if len(turn) == 4 else "rotation"
    for name, first in (("pose", 0), ("pose", 1), ("actualtcppose", 0), ("actualtcppose", 1)):
        six = [f"{name}{k + first}" for k in range(6)]
        if set(six) <= set(numbered) and f"{name}{6 + first}" not in numbered:
            return np.array([values[numbered.index(n)] for n in six], dtype=np.float64), ""
    return None, ""


def _file_like(word: str) -> bool:
    return re.search(r"\.[A-Za-z]{2,5}$", word) is not None


def _read_table(path: Path, text: str, content: Content) -> None:
    """Add the records of a table: a pose in each line, over several lines, or rotations and positions by themselves."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and line.strip()[0] not in "#%"]
    # Commas between digits are decimal commas where something else separates.
    lines = [re.sub(r"(?<=\d),(?=\d)", ".", ln) if ";" in ln or "\t" in ln else ln for ln in lines]
    numbers = [[float(n) for n in NUMBER.findall(line)] for line in lines]
    words = [[w for w in re.split(r"[\s,;=()\[\]{}\"']+", NUMBER.sub(" ", line)) if w] for line in lines]
    header: list[str] = []
    if len(lines) > 1 and not numbers[0] and max(map(len, numbers[1:])) >= min(COUNTS):
        header, lines, numbers, words = _cells(lines[0]), lines[1:], numbers[1:], words[1:]
    for row in words:
        if sum(map(_file_like, row)) > 1:
            content.links.append({str(k): w for k, w in enumerate(filter(_file_like, row))})
    if max(map(len, numbers), default=0) >= min(COUNTS):
        length = 1
    elif len({len(n) for n in numbers}) == 1 and not any(words) and (rows := _half_of(np.array(numbers))) is not None:
        content.halves.append((path, "", rows))
        return
    else:
        # A pose over several lines: the shortest pattern of lines that repeats; mostly there are four.
        patterns = [(len(n), bool(w)) for n, w in zip(numbers, words, strict=True)]
        lengths = sorted({*range(1, min(LONGEST, len(lines)) + 1), len(lines)} - {0}, key=lambda n: n != 4)
        repeating = (n for n in lengths if patterns == patterns[:n] * (len(patterns) // n))
        length = next((n for n in repeating if len(_of_block(words[:n], numbers[:n])) in COUNTS), 0)
        if not length and not content.links:
            raise ValueError(f"it holds {sum(map(len, numbers))} numbers; {NEEDED}")
    blocks = [slice(k, k + length) for k in range(0, len(lines), length)] if length else []
    poses = [_of_block(words[block], numbers[block]) for block in blocks]
    seven = np.array([p for p in poses if len(p) == 7]).reshape(-1, 7)
    quaternions = (seven[:, 3:], seven[:, :4])
    unit = not len(seven) or any(np.abs(np.linalg.norm(q, axis=1) - 1).max() < UNIT_OFF for q in quaternions)
    numbering = next((k for k, name in enumerate(header) if NUMBERING.search(name.lower())), None)
    timing = next((k for k, name in enumerate(header) if re.match(r"time|stamp|t$|sec", name.lower())), None)
    for k, (block, found) in enumerate(zip(blocks, poses, strict=True)):
        if not found:
            continue
        said, cells = [w for row in words[block] for w in row], _cells(lines[block][0])
        named, time, pose = "", None, None
        label = next((w for w in said if Path(w).suffix.lower() in PICTURES), "")
        label = label or ("" if header else next((w.strip(":=") for w in said if re.search(r"\d", w)), ""))
        if len(cells) == len(header):
            values = [float(c) if NUMBER.fullmatch(c) else np.nan for c in cells]
            pose, named = _named_numbers(header, values)
            time = None if timing is None else values[timing]
            label = label or (cells[numbering] if numbering is not None and pose is not None else "")
        if pose is None:
            if len(found) - 1 in COUNTS and (len(found) != 7 or not unit):
                time, found = found[0], found[1:]
                label = label or (f"{time:.0f}" if abs(time) < LARGEST_NUMBER and time == int(time) else "")
            pose = np.array(found)
            if len(pose) not in COUNTS:
                raise ValueError(f"line {k + 1} of its table holds {len(found)} numbers; {NEEDED}")
        content.records.append(PoseRecord(path, "row", label or f"[{k}]", _squared(pose), named=named, time=time))


def _cells(line: str) -> list[str]:
    separator = r"[;\t]" if re.search(r"[;\t]", line) else "," if "," in line else r"\s+"
    return [c.strip().strip("\"'") for c in re.split(separator, line)]


def _of_block(words: Sequence[list[str]], numbers: Sequence[list[float]]) -> list[float]:
    """The numbers of a pose: no number or time in its title, no angles that only say again what a quaternion says."""
    several = any(len(n) > 1 for n in numbers)
    parts = [(" ".join(w).lower(), n) for w, n in zip(words, numbers, strict=True) if len(n) > 1 or not several]
    if any(len(n) == 4 for _, n in parts) and len(parts) > 2:
        parts = [(w, n) for w, n in parts if not re.search(r"\brpy\b|euler", w)]
    said = " ".join(map(" ".join, words)).lower()
    if len(parts) == 2 and re.search(r"(rotation|orientation|quat).*(translation|position)", said):
        parts.reverse()
    return [value for _, part in parts for value in part]


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


def join_halves(halves: Sequence[tuple[Path, str, Array]]) -> tuple[list[PoseRecord], set[Path]]:
    """The poses of halves that belong together by their names or are the only two, and the files they were in."""
    kinds: tuple[list[Any], list[Any]] = ([], [])
    for path, where, rows in halves:
        words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", f"{path.stem} {where}").lower())
        roles = [found for word in words if (found := HALVES.fullmatch(word))]
        turns = rows.shape[1] != 3 or (bool(roles) and not any(found[1] for found in roles))
        kinds[not turns].append((path, where, rows, [word for word in words if not HALVES.fullmatch(word)]))
    records: list[PoseRecord] = []
    used: set[Path] = set()
    for path, where, turns, rest in kinds[0]:
        near = [place for place in kinds[1] if len(place[2]) == len(turns) and place[0].parent == path.parent]
        named = [place for place in near if place[3] == rest]
        if len(named) != 1 and sum(len(other[2]) == len(turns) for other in kinds[0]) == 1:
            named = near
        if len(named) == 1:
            matrices, field_name = turns.shape[1] == 9, f"{where}+{named[0][1]}" if where else "row"
            both = np.hstack([turns, named[0][2]] if matrices else [named[0][2], turns])
            said = "rotation" if turns.shape[1] == 3 else ""
            records += [PoseRecord(path, field_name, f"[{k}]", _squared(row), said) for k, row in enumerate(both)]
            used |= {path, named[0][0]}
    return records, used
