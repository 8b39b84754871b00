"""Which pose, and which second picture, belongs to which picture: by a table, by name, by number, by time, in order."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.calibration.recorded.listing import PICTURES

# Words that say what is in a file and not which frame it is of.
ROLES = (
    "laser|stripe|line|image|img|frame|picture|pic|photo|pose|poses|tcp|robot|flange|board|chess|chessboard|charuco|"
    "color|colour|rgb|gray|grey|cam|camera|on|off|light|dark|copy|kopie|copie"
)
# Words for pictures that somebody's program made of others: with the board drawn in, or the lens taken out.
MADE = (
    "corners?|drawn|draw|detected|detections?|annotated|overlay|vis|visuali[sz]ed|visuali[sz]ations?|undist|undistorted|"
    "rectified|remapped|debug"
)
CLOCK = re.compile(r"\d{9,}(?:[._]\d+)?")


@dataclass(frozen=True)
class Matched:
    """`of[k]` is the index of what belongs to picture k, or None; `by` says how; `alone` are indices left over."""

    of: list[int | None]
    by: str
    alone: list[int]
    doubled: dict[int, list[int]]


def match(pictures: Sequence[str], labels: Sequence[str | None], times: Sequence[float | None]) -> Matched:
    """The label that belongs to each picture (names below the folder); the first way that serves most of them."""
    ways = [
        ("name", list(pictures), [_as_path(x) for x in labels]),
        ("name", [Path(p).name for p in pictures], [Path(_as_path(x)).name for x in labels]),
        ("name", [_stem(p) for p in pictures], [_stem(_as_path(x)) for x in labels]),
        ("name", [_plain(p) for p in pictures], [_plain(_as_path(x)) for x in labels]),
        ("number", numbers(list(pictures)), numbers([_as_path(x) for x in labels])),
    ]
    best: Matched | None = None
    for by, left, right in ways:
        if by == "number" and any(x is not None and x.startswith("[") for x in labels):
            continue
        found = _equal(left, right, by)
        hits = sum(k is not None for k in found.of)
        if hits and (best is None or hits > sum(k is not None for k in best.of)):
            best = found
    by_time = _nearest(pictures, labels, times)
    if by_time is not None and (best is None or sum(k is not None for k in best.of) < len(pictures) / 2):
        return by_time
    if best is not None and sum(k is not None for k in best.of) >= min(2, len(pictures)):
        return best
    if len(labels) == len(pictures):
        return Matched(list(range(len(labels))), "order", [], {})
    return best or Matched([None] * len(pictures), "nothing", list(range(len(labels))), {})


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
    of: list[int | None] = []
    doubled: dict[int, list[int]] = {}
    for k, key in enumerate(left):
        hits = many.get(key, [])
        of.append(hits[0] if len(hits) == 1 and (taken[key] == 1 or by == "number") else None)
        if len(hits) > 1:
            doubled[k] = hits
    used = {k for k in of if k is not None} | {k for hits in doubled.values() for k in hits}
    return Matched(of, by, [k for k in range(len(right)) if k not in used], doubled)


def _nearest(pictures: Sequence[str], labels: Sequence[str | None], times: Sequence[float | None]) -> Matched | None:
    """The pose of the nearest time, where names and table have times of the same clock."""
    shown = [_clock(p) for p in pictures]
    told = [t if t is not None and math.isfinite(t) else _clock(x or "") for t, x in zip(times, labels, strict=True)]
    timed = [k for k, t in enumerate(told) if t is not None]
    if len(timed) < 2 or 2 * len(timed) < len(told) or any(s is None for s in shown):
        return None
    for scale in (1.0, 1e-3, 1e-6, 1e-9):
        clock = np.array([s for s in shown if s is not None]) * scale
        table = np.array([t for t in told if t is not None])
        apart = np.abs(clock[:, None] - table[None, :])
        near = apart.argmin(axis=1)
        reach = 0.5 * float(np.median(np.diff(np.sort(clock)))) if len(clock) > 1 else 0.1
        good = apart.min(axis=1) <= max(reach, 1e-3)
        if good.mean() > 0.5 and len(set(near[good].tolist())) == int(good.sum()):
            of = [timed[k] if g else None for k, g in zip(near, good, strict=True)]
            alone = [k for k in range(len(labels)) if k not in set(of)]
            return Matched(of, "time", alone, {})
    return None


def _clock(name: str) -> float | None:
    found = CLOCK.search(Path(name).name if Path(name).suffix.lower() in PICTURES else name)
    return None if found is None else float(found[0].replace("_", "."))


def _as_path(label: str | None) -> str:
    return "" if label is None else label.replace("\\", "/")


def _stem(name: str) -> str:
    path = Path(name)
    return path.stem if path.suffix.lower() in (*PICTURES, ".txt", ".csv", ".json", ".yaml", ".yml") else path.name


def _plain(name: str) -> str:
    """The name without the words that say what is in a file."""
    words = re.split(r"[\s_\-.()]+|(?<=[a-z])(?=\d)", _stem(name).lower())
    told = [w for w in words if w and not re.fullmatch(f"{ROLES}|{MADE}", w)]
    return "-".join(str(int(w)) if w.isdecimal() else w for w in told)


def series_name(name: str) -> str:
    """A file's name with its numbers taken out: files of one series have the same."""
    return re.sub(r"\d+", "N", name.lstrip("_"))


def made_of_others(name: str) -> bool:
    """True for a picture whose name or folder says that a program made it of another."""
    return any(re.fullmatch(MADE, word) for word in re.split(r"[^a-z]+", name.lower()))


def frame_key(name: str) -> str:
    """What two pictures of one frame have in common: their name without folders and the words for what is in them."""
    return _plain(name)
