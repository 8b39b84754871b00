"""From a file to its records of numbers: JSON, YAML, XML, Python tuples, numpy arrays; tables by `tables.py`.

Which numbers mean what is not decided here (`conventions.py`); only names that say it themselves are kept.
"""

from __future__ import annotations

import ast
import json
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cell.calibration.recorded.halves import Half, half_of
from cell.calibration.recorded.keyed import read_keyed
from cell.calibration.recorded.listing import PICTURES
from cell.calibration.recorded.records import COUNTS, Content, Record, file_like, named_numbers
from cell.calibration.recorded.tables import read_table
from cell.calibration.recorded.xml_files import read_xml
from cell.calibration.recorded.yaml_subset import read_yaml
from cell.geometry.camera import Array

# A robtarget of an ABB arm: position and quaternion.
TARGET = re.compile(r"robtarget\s+\w+\s*:=\s*\[\s*\[([^\]]*)\]\s*,\s*\[([^\]]*)\]")
# A pose that a program of a UR arm moves to: position and rotation vector.
MOVE = re.compile(r"\bmove[a-z]+\s*\(\s*p\s*\[([^\]]*)\]")


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
    elif not (_program(path, text, content) or read_keyed(path, text, content) or _printed(path, text, content)):
        read_table(path, text, content)
    return content


def _decoded(data: bytes) -> str:
    for mark, encoding in ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16")):
        if data.startswith(mark):
            return data.decode(encoding, errors="replace")
    if len(data) > 3 and (data[0] == 0) != (data[1] == 0):
        return data[: len(data) // 2 * 2].decode("utf-16-be" if data[0] == 0 else "utf-16-le", errors="replace")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _structured(path: Path, text: str) -> Any:
    """The object of a JSON, YAML, XML or Python text; None for a plain table."""
    suffix, start = path.suffix.lower(), text.lstrip()[:1]
    if suffix == ".json":
        try:
            return json.loads(text)
        except ValueError as error:
            raise ValueError(f"it is no JSON: {error}") from error
    if suffix in (".yaml", ".yml") or text.startswith("%YAML"):
        return read_yaml(text)
    if suffix == ".xml":
        return read_xml(text)
    if start and start in "([{":
        for read in (ast.literal_eval, json.loads):
            try:
                return read(text.strip())
            except (ValueError, SyntaxError):
                continue
    return None


def _program(path: Path, text: str, content: Content) -> bool:
    """Add the poses that an arm's own program moves to, one after the other; False for a text that is none."""
    for found in TARGET.findall(text):
        with suppress(ValueError):
            place, turn = ([float(value) for value in part.split(",")] for part in found)
            if (len(place), len(turn)) == (3, 4):
                content.records.append(Record(path, "row", f"[{len(content.records)}]", np.array([*place, *turn])))
    for found in MOVE.findall(text):
        with suppress(ValueError):
            numbers = np.array([float(value) for value in found.split(",")])
            if len(numbers) == 6:
                content.records.append(Record(path, "row", f"[{len(content.records)}]", numbers, "rotation"))
    return bool(content.records)


def _printed(path: Path, text: str, content: Content) -> bool:
    """Add the poses of a text that is YAML under another name, as rostopic prints messages; False where it is none."""
    if not re.match(r"(?:---\s+)?\w+:\s", text.lstrip()):
        return False
    with suppress(ValueError):
        _walk(path, read_yaml(text), [], None, content)
    return bool(content.records)


def _walk(path: Path, data: Any, place: list[str], label: str | None, content: Content) -> None:
    """Find the poses and the links in nested maps and lists."""
    if isinstance(data, dict):
        strings = {str(k): v for k, v in data.items() if isinstance(v, str)}
        if sum(file_like(v) for v in strings.values()) > 1:
            content.links.append(strings)
        label = next((v for v in strings.values() if Path(v).suffix.lower() in PICTURES), label)
        matrix = _stored_matrix(data)
        if matrix is not None:
            _take(path, matrix, place, label, content)
            return
        found, named = _by_names(data)
        if found is not None:
            label = label or _number_in(place)
            content.records.append(Record(path, _pattern(place), label, found, named, exact=_names(place)))
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
    _take(path, array, place, label, content)


def _take(path: Path, array: Array, place: list[str], label: str | None, content: Content) -> None:
    """Add the pose, the poses or the halves of poses that an array holds."""
    pose = _one(array)
    if pose is not None:
        record = _record(path, _pattern(place), label or _number_in(place), pose)
        content.records.append(replace(record, exact=_names(place)))
    elif array.ndim >= 2 and _one(array[0]) is not None:
        for k, part in enumerate(array):
            one = _one(part)
            assert one is not None
            content.records.append(_record(path, _pattern([*place, f"[{k}]"]), f"[{k}]", one))
    elif (rows := half_of(array)) is not None:
        content.halves.append(Half(path, "/".join(place), rows))


def _array(data: Any) -> Array | None:
    """Numbers of a list, the two parts of ((x, y, z), (…)) one behind the other; None where words are among them."""
    with suppress(TypeError, ValueError):
        return np.asarray(data, dtype=np.float64)
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
    values = {k: v for k, v in low.items() if isinstance(v, (int, float))}
    return named_numbers(list(values), list(values.values()))


def _stored_matrix(data: dict[Any, Any]) -> Array | None:
    """The matrix of a map of rows, cols and data, as OpenCV stores it; its elements may have several channels."""
    if not {"rows", "cols", "data"} <= set(data):
        return None
    array, shape = _array(data["data"]), (data["rows"], data["cols"])
    if array is None or not all(isinstance(n, (int, float)) and n >= 1 and n == int(n) for n in shape):
        return None
    rows, columns = int(shape[0]), int(shape[1])
    if array.size % (rows * columns):
        return None
    return array.reshape((rows, columns) if array.size == rows * columns else (rows, columns, -1))


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


def _pattern(place: list[str]) -> str:
    return "/".join(re.sub(r"\d+", "N", p) for p in place)


def _names(place: list[str]) -> str:
    return "/".join(re.sub(r"\[\d+\]", "[N]", p) for p in place)


def _number_in(place: list[str]) -> str | None:
    return next((p for p in reversed(place) if re.search(r"\d", p)), None)
