"""From the text of a file to its records of numbers: CSV, tables, JSON, YAML, Python tuples, numpy arrays.

Which numbers mean what is not decided here (`conventions.py`); only names that say it themselves are kept.
"""

from __future__ import annotations

import ast
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cell.calibration.recorded.listing import PICTURES
from cell.calibration.recorded.yaml_subset import read_yaml
from cell.geometry.camera import Array

# Numbers of a pose: 6, 7, 3×4, 4×4; one more in front is a time or a number.
COUNTS = (6, 7, 12, 16)
NUMBER = r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf(?:inity)?)"
# What a column of a position may begin with, and what those of a rotation are called.
PREFIXES = ("", "t", "p", "pos", "trans", "translation", "position", "tcp", "flange", "robot", "pose")
TURNS = (
    (("qx", "qy", "qz", "qw"), "quaternion"),
    (("x", "y", "z", "w"), "quaternion"),
    (("rx", "ry", "rz"), "rotation"),
    (("roll", "pitch", "yaw"), "rotation"),
    (("a", "b", "c"), "rotation"),
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


@dataclass
class Content:
    """What a text holds: records, and links between files that it names (picture, role or name of the other, file)."""

    records: list[Record] = field(default_factory=list)
    links: list[dict[str, str]] = field(default_factory=list)


def read_content(path: Path) -> Content:
    """Records and links of a file. Raises ValueError that says what is wrong with it."""
    content = Content()
    if path.suffix.lower() in (".npy", ".npz"):
        loaded = np.load(path, allow_pickle=False)
        data = loaded.tolist() if isinstance(loaded, np.ndarray) else {k: loaded[k].tolist() for k in loaded.files}
        _walk(path, data, [], None, content)
        return content
    # As numpy prints its numbers and arrays.
    text = re.sub(r"(?:np\.|numpy\.)?(?:float\d+|array)\(([^()]*)\)", r"\1", _decoded(path.read_bytes()))
    if not text.strip():
        raise ValueError("it is empty")
    if text.startswith("version https://git-lfs"):
        raise ValueError("it only points to a file that was not fetched (Git LFS)")
    data = _structured(path, text)
    if data is not None:
        _walk(path, data, [], None, content)
    else:
        _table(path, text, content)
    return content


def _decoded(data: bytes) -> str:
    for mark, encoding in ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16")):
        if data.startswith(mark):
            return data.decode(encoding, errors="replace")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _structured(path: Path, text: str) -> Any:
    """The object of a JSON, YAML or Python text; None for a plain table."""
    suffix, start = path.suffix.lower(), text.lstrip()[:1]
    if suffix == ".json":
        try:
            return json.loads(text)
        except ValueError as error:
            raise ValueError(f"it is no JSON: {error}") from error
    if suffix in (".yaml", ".yml") or text.startswith("%YAML"):
        return read_yaml(text)
    if start and start in "([{":
        for read in (ast.literal_eval, json.loads):
            try:
                return read(text.strip())
            except (ValueError, SyntaxError):
                continue
    return None


def _walk(path: Path, data: Any, place: list[str], label: str | None, content: Content) -> None:
    """Find the poses and the links in nested maps and lists."""
    if isinstance(data, dict):
        strings = {str(k): v for k, v in data.items() if isinstance(v, str)}
        if sum(_file_like(v) for v in strings.values()) > 1:
            content.links.append(strings)
        label = next((v for v in strings.values() if Path(v).suffix.lower() in PICTURES), label)
        found, named = _by_names(data)
        if found is not None:
            content.records.append(Record(path, _pattern(place), label or _number_in(place), found, named))
            return
        for key, value in data.items():
            _walk(path, value, [*place, str(key)], label, content)
        return
    if not isinstance(data, (list, tuple)) or not len(data):
        return
    array = _array(data)
    if array is None:
        for k, value in enumerate(data):
            _walk(path, value, [*place, f"[{k}]"], label, content)
        return
    pose = _one(array)
    if pose is not None:
        content.records.append(_record(path, _pattern(place), label or _number_in(place), pose))
    elif array.ndim >= 2 and _one(array[0]) is not None:
        for k, part in enumerate(array):
            one = _one(part)
            assert one is not None
            content.records.append(_record(path, _pattern([*place, f"[{k}]"]), f"[{k}]", one))


def _array(data: Any) -> Array | None:
    """Numbers of a list, the two parts of ((x, y, z), (…)) one behind the other; None where words are among them."""
    try:
        return np.asarray(data, dtype=np.float64)
    except (TypeError, ValueError):
        pass
    try:
        parts = [np.ravel(np.asarray(part, dtype=np.float64)) for part in data]
    except (TypeError, ValueError):
        return None
    return np.concatenate(parts) if len(parts) == 2 and len(parts[0]) in (3, 4) else None


def _one(array: Array) -> Array | None:
    """The numbers of one pose, or None for another shape."""
    if array.ndim == 2 and 1 in array.shape:
        array = array.ravel()
    if array.ndim == 1 and (len(array) in COUNTS or len(array) - 1 in COUNTS):
        return array
    return array.ravel() if array.shape in ((4, 4), (3, 4)) else None


def _record(path: Path, field_name: str, label: str | None, numbers: Array) -> Record:
    if len(numbers) - 1 in (7, 12, 16):
        return Record(path, field_name, label, numbers[1:], time=float(numbers[0]))
    return Record(path, field_name, label, numbers)


def _by_names(data: dict[Any, Any]) -> tuple[Array | None, str]:
    """A pose of a map whose keys say what is what."""
    low = {re.sub(r"[^a-z0-9]", "", str(k).lower()): v for k, v in data.items()}
    if {"rows", "cols", "data"} <= set(low):
        array, shape = _array(low["data"]), (low["rows"], low["cols"])
        if array is not None and all(isinstance(n, int) for n in shape) and array.size == shape[0] * shape[1]:
            return _one(array.reshape(shape)), ""
        return None, ""
    position = _part(low, ("position", "translation", "t", "trans", "tvec", "pos", "xyz"))
    turn = _part(low, ("orientation", "rotation", "quaternion", "quat", "q", "r", "rot", "rvec", "rpy"))
    if position is not None and turn is not None and len(position[0]) == 3:
        numbers, names = turn
        if len(numbers) == 4 and names == "quaternion":
            return np.concatenate([position[0], numbers]), "quaternion"
        if len(numbers) in (3, 4):
            return np.concatenate([position[0], numbers]), ""
        if len(numbers) == 9:
            return np.column_stack([numbers.reshape(3, 3), position[0]]).ravel(), ""
    if all(isinstance(v, (int, float)) for v in low.values()):
        return named_numbers(list(low), list(low.values()))
    return None, ""


def _part(low: dict[str, Any], keys: tuple[str, ...]) -> tuple[Array, str] | None:
    value = next((low[k] for k in keys if k in low), None)
    if isinstance(value, dict):
        inner = {str(k).lower().lstrip("q"): v for k, v in value.items()}
        for names, kind in (("xyzw", "quaternion"), ("xyz", "")):
            if set(inner) == set(names):
                array = _array([inner[n] for n in names])
                return None if array is None else (array, kind)
        found, _ = _by_names({str(k): v for k, v in value.items()}) if "data" in inner else (None, "")
        return None if found is None else (found, "")
    array = _array(value) if isinstance(value, (list, tuple)) else None
    return None if array is None else (array.ravel(), "")


def named_numbers(names: list[str], values: list[Any]) -> tuple[Array | None, str]:
    """A pose of columns or keys such as x y z qx qy qz qw, x y z rx ry rz, in any order, others beside."""
    clean = [re.sub(r"\(.*?\)|\[.*?\]|_?(?:mm|deg|rad|m)$|[^a-z]", "", n.lower()) for n in names]
    for prefix in PREFIXES:
        place = [clean.index(prefix + a) if prefix + a in clean else -1 for a in "xyz"]
        if min(place) < 0:
            continue
        for turn, kind in TURNS:
            where = [clean.index(t) if t in clean else -1 for t in turn]
            if min(where) >= 0 and not (turn[0] == "x" and prefix == ""):
                return np.array([values[k] for k in (*place, *where)], dtype=np.float64), kind
    return None, ""


def _file_like(word: str) -> bool:
    return re.search(r"\.[A-Za-z]{2,5}$", word) is not None


def _pattern(place: list[str]) -> str:
    return "/".join(re.sub(r"\d+", "N", p) for p in place)


def _number_in(place: list[str]) -> str | None:
    return next((p for p in reversed(place) if re.search(r"\d", p)), None)


def _table(path: Path, text: str, content: Content) -> None:
    """Rows of numbers, with or without names above and words beside them; or one pose over several rows."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and line.strip()[:1] not in "#%"]
    rows = [_cells(line) for line in lines]
    header = rows.pop(0) if len(rows) > 1 and not any(_number(c) is not None for c in rows[0]) else None
    numbers = [[v for v in (_number(c) for c in row) if v is not None] for row in rows]
    words = [[c for c in row if _number(c) is None] for row in rows]
    widths = {len(n) for n in numbers}
    if header is None and not any(words) and len(widths) == 1 and widths <= {1, 3, 4}:
        flat = np.concatenate([np.array(n) for n in numbers])
        stack = flat.reshape(-1, 4, 4) if widths == {4} and len(numbers) % 4 == 0 else None
        if stack is not None and len(stack) > 1:
            content.records += [Record(path, "matrix", f"[{k}]", m.ravel()) for k, m in enumerate(stack)]
            return
        if len(flat) in COUNTS:
            content.records.append(Record(path, "", None, flat))
            return
        raise ValueError(f"it holds {len(flat)} numbers; a pose has 6, 7, 12 or 16")
    if (
        header is None
        and not any(words)
        and sum(len(n) for n in numbers) in COUNTS
        and len(rows) > 1
        and len(widths) > 1
    ):
        content.records.append(Record(path, "", None, np.concatenate([np.array(n) for n in numbers])))
        return
    for k, (row, found, word) in enumerate(zip(rows, numbers, words, strict=True)):
        label = next((w for w in word if Path(w).suffix.lower() in PICTURES), word[0] if word else f"[{k}]")
        if sum(_file_like(w) for w in word) > 1:
            names = header if header is not None and len(header) == len(row) else [str(i) for i in range(len(row))]
            content.links.append({n: c for n, c in zip(names, row, strict=True) if _file_like(c)})
        if not found:
            continue
        record = _row(path, header, row, found, label)
        if record is None:
            raise ValueError(f"line {k + 1} of its table holds {len(found)} numbers; a pose has 6, 7, 12 or 16")
        content.records.append(record)


def _row(path: Path, header: list[str] | None, row: list[str], found: list[float], label: str) -> Record | None:
    if header is not None and len(header) == len(row):
        values = [v if (v := _number(c)) is not None else float("nan") for c in row]
        pose, named = named_numbers(header, values)
        if pose is not None:
            clock = [v for h, v in zip(header, values, strict=True) if re.match(r"(time|stamp|t$|sec)", h.lower())]
            first = header[0].lower()
            if label.startswith("[") and re.search(r"id|index|frame|image|no\b|num|^n$|pic", first):
                label = row[0]
            return Record(path, "row", label, pose, named, clock[0] if clock else None)
    numbers = np.array(found)
    if len(numbers) in COUNTS and not (len(numbers) == 7 and label.startswith("[") and _counts(found, label)):
        return Record(path, "row", label, numbers)
    if len(numbers) - 1 in COUNTS:
        own = f"{found[0]:.0f}" if found[0] == int(found[0]) and abs(found[0]) < 1e6 else label
        return Record(path, "row", own if label.startswith("[") else label, numbers[1:], time=found[0])
    return None


def _counts(found: list[float], label: str) -> bool:
    """True for a first number that only counts the rows."""
    return found[0] - int(label[1:-1]) in (0.0, 1.0) and abs(sum(v * v for v in found[3:]) - 1) > 0.02


def _cells(line: str) -> list[str]:
    """The words of a row; commas between digits are decimal commas where something else separates."""
    if ";" in line or "\t" in line:
        return [c.strip().strip("\"'") for c in re.split(r"[;\t]", line) if c.strip()]
    bare = re.split(r"\s+", re.sub(r"[()\[\]]", " ", line).strip())
    if len(bare) > 1 and all(re.fullmatch(NUMBER, c, re.IGNORECASE) for c in bare) and any("," in c for c in bare):
        return bare
    parts = line.split(",")
    if len(parts) <= min(COUNTS):
        parts = re.split(r"\s*,\s*|\s+", line.strip())
    return [c for c in (re.sub(r"[()\[\]\"']", "", p).strip() for p in parts) if c]


def _number(cell: str) -> float | None:
    if not re.fullmatch(NUMBER, cell, re.IGNORECASE):
        return None
    return float(cell.replace(",", "."))
