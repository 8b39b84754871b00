"""Which pose belongs to which picture: by name, by folder, by number, by time, in order."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.calibration.recorded.listing import TEXTS
from cell.calibration.recorded.texts import PICTURES

# Words that say what is in a file and not which frame it is of.
ROLES = (
    "laser|stripe|line|image|img|frame|picture|pic|photo|pose|poses|tcp|robot|flange|board|chess|chessboard|charuco|"
    "color|colour|rgb|gray|grey|cam|camera|on|off|light|dark|copy|kopie|copie"
)
CLOCK = re.compile(r"\d{9,}(?:[._]\d+)?")


@dataclass(frozen=True)
class Matched:
    """`of[k]` is the index of what belongs to picture k, or None; `by` says how; `alone` are indices left over."""

    of: list[int | None]
    by: str
    alone: list[int]
    doubled: dict[int, list[int]]

    @property
    def hits(self) -> int:
        """How many pictures have what belongs to them."""
        return sum(k is not None for k in self.of)


def match(pictures: Sequence[str], labels: Sequence[str | None], times: Sequence[float | None]) -> Matched:
    """The label that belongs to each picture (names below the folder); the first way that serves most of them."""
    told = ["" if label is None else label.replace("\\", "/") for label in labels]
    both = (list(pictures), told)
    ways = [("name", [[of(x) for x in side] for side in both]) for of in (str, _file, _stem, frame_key)]
    # A folder for each pose.
    ways.append(("folder", [[str(Path(x).parent) for x in side] for side in both]))
    if not any(x.startswith("[") for x in told):
        ways.append(("number", [numbers(side) for side in both]))
    best = max((_equal(left, right, by) for by, (left, right) in ways), key=lambda found: found.hits)
    by_time = _nearest(pictures, told, times)
    if by_time is not None and best.hits < len(pictures) / 2:
        return by_time
    if len(labels) == len(pictures) and best.hits < 2:
        return Matched(list(range(len(labels))), "order", [], {})
    return best


def numbers(names: list[str]) -> list[str]:
    """The numbers in each name that differ from name to name, as one word; empty where there is none."""
    found = [[int(d) for d in re.findall(r"\d+", str(Path(n).with_suffix("")) if "." in n else n)] for n in names]
    length = Counter(map(len, found)).most_common(1)[0][0] if found else 0
    usual = [f for f in found if len(f) == length]
    varying = [k for k in range(length) if len({f[k] for f in usual}) > 1] or list(range(length))[-1:]
    # A folder's number that goes with the file's adds nothing.
    if len({tuple(f[k] for k in varying[-1:]) for f in usual}) == len(usual):
        varying = varying[-1:]
    return ["-".join(str(f[k]) for k in varying) if len(f) == length and varying else "" for f in found]


def _equal(left: list[str], right: list[str], by: str) -> Matched:
    many: dict[str, list[int]] = {}
    for k, key in enumerate(right):
        if key:
            many.setdefault(key, []).append(k)
    taken = Counter(key for key in left if key in many)
    hits = [many.get(key, []) for key in left]
    of = [
        h[0] if len(h) == 1 and (taken[key] == 1 or by != "name") else None for h, key in zip(hits, left, strict=True)
    ]
    used = {k for h in hits if len(h) > 1 for k in h} | {k for k in of if k is not None}
    alone = [k for k in range(len(right)) if k not in used]
    return Matched(of, by, alone, {k: h for k, h in enumerate(hits) if len(h) > 1})


def _nearest(pictures: Sequence[str], labels: Sequence[str], times: Sequence[float | None]) -> Matched | None:
    """The pose of the nearest time, where names and table have times of the same clock."""
    shown = [_clock(Path(p).name) for p in pictures]
    told = [t if t is not None and math.isfinite(t) else _clock(x) for t, x in zip(times, labels, strict=True)]
    timed = [k for k, t in enumerate(told) if t is not None]
    if len(timed) < 2 or 2 * len(timed) < len(told) or any(s is None for s in shown):
        return None
    table = np.array([t for t in told if t is not None])
    for scale in (1.0, 1e-3, 1e-6, 1e-9):
        clock = np.array([s for s in shown if s is not None]) * scale
        apart = np.abs(clock[:, None] - table[None, :])
        near, reach = apart.argmin(axis=1), 0.5 * float(np.median(np.diff(np.sort(clock)))) if len(clock) > 1 else 0.1
        good = apart.min(axis=1) <= max(reach, 1e-3)
        if good.mean() > 0.5 and len(set(near[good].tolist())) == int(good.sum()):
            of = [timed[k] if g else None for k, g in zip(near, good, strict=True)]
            return Matched(of, "time", [k for k in range(len(labels)) if k not in of], {})
    return None


def _clock(name: str) -> float | None:
    found = CLOCK.search(name)
    return None if found is None else float(found[0].replace("_", "."))


def _file(name: str) -> str:
    return Path(name).name


def _stem(name: str) -> str:
    path = Path(name)
    return path.stem if path.suffix.lower() in (*PICTURES, *TEXTS) else path.name


def series_name(name: str) -> str:
    """A file's name with its numbers taken out: files of one series have the same."""
    return re.sub(r"\d+", "N", name.lstrip("_"))


def frame_key(name: str) -> str:
    """What two pictures of one frame have in common: their name without folders and the words for what is in them."""
    words = re.split(r"[\s_\-.()]+|(?<=[a-z])(?=\d)", _stem(name).lower())
    told = [w for w in words if w and not re.fullmatch(ROLES, w)]
    return "-".join(str(int(w)) if w.isdecimal() else w for w in told)
