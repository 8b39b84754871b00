"""Tables of poses: rows of numbers with or without names above and words beside, blocks below titles, or one pose."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from cell.calibration.recorded.halves import Half, half_of
from cell.calibration.recorded.listing import PICTURES
from cell.calibration.recorded.records import COUNTS, Content, Record, file_like, named_numbers
from cell.calibration.recorded.several_lines import read_several_lines

NUMBER = r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf(?:inity)?)"
# No position is as large: what stands in front of a pose is a time.
LEAST_TIME = 1e6
# Columns whose words name no picture.
REMARKS = re.compile(r"comment|remark|note|status|result|kommentar|bemerkung", re.IGNORECASE)


def read_table(path: Path, text: str, content: Content) -> None:
    """Add the records of a table. Raises ValueError that says what is wrong with it."""
    lines = [line.strip(" \r") for line in text.splitlines() if line.strip() and line.strip()[:1] not in "#%"]
    cells = [_cells(line) for line in lines]
    rows = [[c for c in row if c] for row in cells]
    if _blocks(path, rows, content) or read_several_lines(path, [_apart(row) for row in rows], content):
        return
    if _halves(path, rows, content):
        return
    header = None
    if len(rows) > 1 and not any(_number(c) is not None for c in rows[0]):
        header, cells = cells[0], cells[1:]
        if not any(len(full) == len(header) for full in cells):
            header = rows[0]
        rows = rows[1:]
        # Below names an empty cell keeps its place.
        rows = [full if len(full) == len(header) else row for full, row in zip(cells, rows, strict=True)]
    numbers = [[v for v in (_number(c) for c in row) if v is not None] for row in rows]
    if header is None and _one_pose(path, rows, numbers, content):
        return
    told = _labels(header, rows)
    numbered = _numbered(numbers)
    for k, (row, found) in enumerate(zip(rows, numbers, strict=True)):
        words = [c for c in row if c and _number(c) is None]
        label = next((w for w in words if Path(w).suffix.lower() in PICTURES), told[k])
        if sum(file_like(w) for w in words) > 1:
            names = header if header is not None and len(header) == len(row) else [str(i) for i in range(len(row))]
            content.links.append({n: c for n, c in zip(names, row, strict=True) if file_like(c)})
        if not found:
            continue
        if numbered and label.startswith("["):
            label, found = f"{found[0]:.0f}", found[1:]
        record = _row(path, header, row, found, label)
        if record is None:
            raise ValueError(f"line {k + 1} of its table holds {len(found)} numbers; a pose has 6, 7, 12 or 16")
        content.records.append(record)


def _apart(row: list[str]) -> tuple[list[str], list[float]]:
    """The words and the numbers of a row."""
    found = [(cell, _number(cell)) for cell in row]
    return [cell for cell, value in found if value is None], [value for _, value in found if value is not None]


def _blocks(path: Path, rows: list[list[str]], content: Content) -> bool:
    """Add poses below titles such as "Pose 1:"; False where the table is none of these."""
    titles: list[str] = []
    poses: list[list[float]] = []
    for row in rows:
        numbers = [v for v in (_number(c) for c in row) if v is not None]
        if len(numbers) < len(row):
            titles.append(" ".join(row).strip(" :="))
            poses.append([])
        elif titles:
            poses[-1] += numbers
        else:
            return False
    if len(titles) < 2 or len(poses[0]) not in COUNTS or len({len(p) for p in poses}) > 1:
        return False
    content.records += [
        Record(path, "matrix" if len(p) > 7 else "row", t, np.array(p)) for t, p in zip(titles, poses, strict=True)
    ]
    return True


def _halves(path: Path, rows: list[list[str]], content: Content) -> bool:
    """Add rows that are rotations only, or positions only; False for a table that is none of these, or one pose."""
    numbers = [[_number(c) for c in row] for row in rows]
    widths = {len(row) for row in numbers}
    if len(widths) != 1 or not widths <= {3, 4, 9} or any(v is None for row in numbers for v in row):
        return False
    array = np.array(numbers, dtype=np.float64)
    found = None if array.size in COUNTS else half_of(array)
    if found is not None:
        content.halves.append(Half(path, "", found))
    return found is not None


def _one_pose(path: Path, rows: list[list[str]], numbers: list[list[float]], content: Content) -> bool:
    """Add one pose that goes over several rows, or matrices below each other; False for rows that are poses."""
    widths = {len(n) for n in numbers}
    if any(len(n) < len(row) for n, row in zip(numbers, rows, strict=True)):
        return False
    flat = np.concatenate([np.array(n) for n in numbers])
    if len(widths) == 1 and widths <= {1, 3, 4}:
        if widths == {4} and len(numbers) % 4 == 0 and len(numbers) > 4:
            stack = flat.reshape(-1, 4, 4)
            content.records += [Record(path, "matrix", f"[{k}]", m.ravel()) for k, m in enumerate(stack)]
        elif len(flat) in COUNTS:
            content.records.append(Record(path, "", None, flat))
        else:
            raise ValueError(f"it holds {len(flat)} numbers; a pose has 6, 7, 12 or 16")
        return True
    if len(flat) in COUNTS and len(rows) > 1 and len(widths) > 1:
        content.records.append(Record(path, "", None, flat))
        return True
    return False


def _labels(header: list[str] | None, rows: list[list[str]]) -> list[str]:
    """What each row is called: its first word, below names that of the first column that has one in every row."""
    columns: list[int] = []
    if header is not None and all(len(row) == len(header) for row in rows):
        columns = [k for k, name in enumerate(header) if not REMARKS.search(name)]
        columns = [k for k in columns if all(row[k] and _number(row[k]) is None for row in rows)]
        return [row[columns[0]] if columns else f"[{k}]" for k, row in enumerate(rows)]
    return [next((c for c in row if c and _number(c) is None), f"[{k}]") for k, row in enumerate(rows)]


def _numbered(numbers: list[list[float]]) -> bool:
    """True for rows of seven of which the first is a number of its own in each, and no quaternion is behind it."""
    first = [row[0] for row in numbers if row]
    return (
        all(len(row) == 7 and row[0] == row[0] // 1 and abs(sum(v * v for v in row[3:]) - 1) > 0.02 for row in numbers)
        and len(set(first)) == len(first) > 2
        and max(map(abs, first)) < LEAST_TIME
    )


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
    if len(numbers) == 7 and LEAST_TIME <= abs(numbers[0]) < np.inf:
        return Record(path, "row", label, numbers[1:], time=found[0])
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
    """The cells of a row, some empty; commas between digits are decimal commas where something else separates.

    As the arm's own script has it, p[x, y, z, rx, ry, rz] is a pose; some print it as p(…).
    """
    line = re.sub(r"\bp\s*([\[(])", r" \1", line).strip(" ")
    if ";" in line or "\t" in line:
        return [c.strip().strip("\"'") for c in re.split(r"[;\t]", line)]
    bare = re.split(r"\s+", re.sub(r"[()\[\]]", " ", line).strip())
    if len(bare) > 1 and all(re.fullmatch(NUMBER, c, re.IGNORECASE) for c in bare) and any("," in c for c in bare):
        return bare
    parts = line.split(",")
    if len(parts) <= min(COUNTS):
        parts = re.split(r"\s*,\s*|\s+", line)
    return [re.sub(r"[()\[\]\"']", "", p).strip() for p in parts]


def _number(cell: str) -> float | None:
    if not re.fullmatch(NUMBER, cell, re.IGNORECASE):
        return None
    return float(cell.replace(",", "."))
