"""Poses whose numbers have their names before them: {X 10.5, Y 3, Z 7, A 90, B 0, C 180}, X = 10.5 mm, x: 0.1.

As arms and their pendants show them, one pose in a line or over several lines. No tables with names above.
"""

from __future__ import annotations

import re
from pathlib import Path

from cell.calibration.recorded.listing import PICTURES
from cell.calibration.recorded.records import Content, Record, named_numbers

PAIR = re.compile(r"(?<![\w.])([A-Za-z]{1,5})(?:\s*[:=]\s*|\s+)([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?![\w.:])")
FIRST = "x"


def read_keyed(path: Path, text: str, content: Content) -> bool:
    """Add the poses of a text whose numbers are named one by one; False, and nothing added, for a text that is none.

    A pose begins with its x. A line's picture is the pose's, if one is named before it.
    """
    groups: list[dict[str, float]] = []
    labels: list[str | None] = []
    picture: str | None = None
    for line in text.splitlines():
        named = next((w for w in re.split(r"[\s,;:\"']+", line) if Path(w).suffix.lower() in PICTURES), None)
        picture = named or picture
        for name, value in PAIR.findall(line if named is None else line.replace(named, " ")):
            if name.lower() == FIRST:
                groups.append({})
                labels.append(picture)
                picture = None
            if groups:
                groups[-1].setdefault(name.lower(), float(value))
    records = []
    for k, (group, label) in enumerate(zip(groups, labels, strict=True)):
        numbers, kind = named_numbers(list(group), list(group.values()))
        if numbers is None:
            return False
        records.append(Record(path, "row", label or f"[{k}]", numbers, kind))
    if len(records) == 1:
        records = [Record(path, "", None, records[0].numbers, records[0].named)]
    content.records += records
    return bool(records)
