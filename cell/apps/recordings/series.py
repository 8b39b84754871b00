"""Series of recorded poses, and the picture of each: by a table, by name, folder, number or time, or in order.

Also what lies in a recording's folder and its sub-folders: pictures, texts, and what is neither, by name.
"""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from cell.apps.recordings.conventions import PoseReading
from cell.apps.recordings.texts import NEEDED, PICTURES, Content, PoseRecord, join_halves, read_content
from cell.measure.vision.pictures import Reason
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from cell.apps.recordings.frames import RecordedFrame

TEXTS = (".txt", ".script", ".csv", ".tsv", ".dat", ".json", ".yaml", ".yml", ".xml", ".npy", ".npz", ".pos")
OTHERS = {
    (".zip", ".gz", ".tar", ".tgz", ".7z", ".rar", ".bz2", ".xz"): "an archive: unpack it",
    (".bag", ".db3", ".mcap"): "a ROS bag: export its pictures and poses to files",
    (".mp4", ".avi", ".mov", ".mkv", ".webm"): "a film: save its pictures to files",
    (".xlsx", ".xls", ".ods"): "a spreadsheet: save it as CSV",
    (".mat",): "a file of MATLAB: save its poses with writematrix as CSV",
    (".pkl", ".pickle"): "a pickle, which may run code when it is read: save its arrays with numpy.savez",
}
LARGEST_TEXT = 50_000_000
# Poses of a series; different rows of a table whose rows are poses.
LEAST, LEAST_ALONE = 2, 3
# Pictures that are no view of their own.
ASIDE = (Reason.DUPLICATE, Reason.WRONG_SIZE, Reason.LASER_PICTURE, Reason.UNREADABLE)
# Words that say what is in a file and not which frame it is of.
ROLES = (
    "laser|stripe|line|image|img|frame|picture|pic|photo|pose|poses|tcp|robot|flange|board|chess|chessboard|charuco|"
    "color|colour|rgb|gray|grey|cam|camera|on|off|light|dark|copy|kopie|copie"
)
CLOCK = re.compile(r"\d{9,}(?:[._]\d+)?")


@dataclass
class Listing:
    """The files of a folder by kind, each in natural order; `unread`: (name, reason) of the others."""

    folder: Path
    pictures: list[Path] = field(default_factory=list)
    texts: list[Path] = field(default_factory=list)
    unread: list[tuple[str, str]] = field(default_factory=list)

    def name(self, path: Path) -> str:
        """A file's name below the folder."""
        return path.relative_to(self.folder).as_posix()


def list_folder(folder: Path) -> Listing:
    """All files of a folder and below. Raises ConfigError when it is no folder."""
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder; give the folder that holds the recorded frames")
    listing = Listing(folder)
    seen: set[str] = set()
    for root, folders, files in os.walk(folder, followlinks=True):
        if os.path.realpath(root) in seen:
            folders.clear()
            continue
        seen.add(os.path.realpath(root))
        for name in [f for f in folders if f.startswith((".", "__MACOSX"))]:
            folders.remove(name)
            listing.unread.append((listing.name(Path(root, name)) + "/", "hidden, not read"))
        for path in (Path(root, name) for name in files):
            if reason := _why_not(path):
                listing.unread.append((listing.name(path), reason))
            else:
                (listing.pictures if path.suffix.lower() in PICTURES else listing.texts).append(path)
    for paths in (listing.pictures, listing.texts):
        paths.sort(key=lambda p: _natural(listing.name(p)))
    listing.unread.sort(key=lambda u: _natural(u[0]))
    return listing


def _natural(name: str) -> list[tuple[int, int, str]]:
    """A sort key in which frame10 follows frame9."""
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in re.split(r"(\d+)", name.lower()) if p]


def _why_not(path: Path) -> str:
    """Why a file is neither a picture nor a text that may be read; empty where it is."""
    suffix = path.suffix.lower()
    if path.name.startswith((".", "__MACOSX")):
        return "hidden, not read"
    if not path.is_file():
        return "no ordinary file" if path.exists() else "a link to a file that is not there"
    if suffix in TEXTS and path.stat().st_size > LARGEST_TEXT:
        return f"{path.stat().st_size / 1e6:.0f} MB are too much for a table of poses"
    if suffix in (*PICTURES, *TEXTS):
        return ""
    return next((r for kinds, r in OTHERS.items() if suffix in kinds), "neither a picture nor a table that is known")


@dataclass(eq=False)
class Series:
    """Records of one kind, and in `of` the record of each picture by the picture's index; `by` says how they match.
    `alone`: records of no picture. `doubled`: the records of a picture that has several."""

    name: str
    records: list[PoseRecord]
    of: dict[int, PoseRecord] = field(default_factory=dict)
    by: str = ""
    alone: list[PoseRecord] = field(default_factory=list)
    doubled: dict[int, list[PoseRecord]] = field(default_factory=dict)

    def named(self, record: PoseRecord) -> str:
        """A record's file, with its label where the file holds several."""
        several = sum(other.path == record.path for other in self.records) > 1
        return record.path.name + (f" {record.label}" if several and record.label else "")

    def poses(self, reading: PoseReading) -> dict[int, pin.SE3]:
        """Poses by picture in the unit of the file, without those that the reading makes no pose of."""
        found = {}
        for k, record in self.of.items():
            if np.isfinite(record.numbers).all():
                try:
                    found[k] = reading.pose(record.numbers)
                except ValueError:
                    continue
        return found


def read_series(listing: Listing) -> tuple[list[Series], list[dict[str, str]], list[tuple[str, str]]]:
    """All series of a folder, the links between its files, and the texts that could not be read, with the reason."""
    contents, unread = _read_texts(listing)
    joined, paired = join_halves([half for content in contents for half in content.halves])
    for content in contents:
        name = listing.name(content.path)
        if content.halves and not content.records and content.path not in paired:
            what = "positions or rotations only: name both files alike, such as R_gripper2base.txt and"
            unread.append((name, f"it holds {what} t_gripper2base.txt"))
        elif not (content.records or content.links or content.halves):
            unread.append((name, f"no pose is in it ({NEEDED} numbers)"))
    found = _grouped(listing, contents, joined)
    few = "one pose, of a kind that no other file has"
    unread += [(listing.name(one.records[0].path), few) for one in found if len(one.records) < LEAST]
    links = [link for content in contents for link in content.links]
    return [one for one in found if len(one.records) >= LEAST], links, unread


def _read_texts(listing: Listing) -> tuple[list[Content], list[tuple[str, str]]]:
    """What the texts of a folder hold, and those that cannot be read, with the reason."""
    contents: list[Content] = []
    unread: list[tuple[str, str]] = []
    for path in listing.texts:
        try:
            contents.append(read_content(path))
        except ValueError as error:
            unread.append((listing.name(path), str(error)))
        except Exception as error:
            # Whatever a stray file holds, and whichever reader it upsets: the others are read all the same.
            unread.append((listing.name(path), f"it cannot be read ({type(error).__name__}): {error}"))
    return contents, unread


def _grouped(listing: Listing, contents: Iterable[Content], joined: Sequence[PoseRecord]) -> list[Series]:
    """Records of one place in one file, or of one place in files that are named alike."""
    groups: dict[tuple[str, str, int], list[PoseRecord]] = {}
    for record in joined:
        groups.setdefault((listing.name(record.path), record.field, len(record.numbers)), []).append(record)
    alike = Counter((path.parent, _series_name(path.name)) for path in listing.texts)
    for content in contents:
        fields = Counter(record.field for record in content.records)
        kind = _series_name(content.path.name)
        for record in content.records:
            source, place = listing.name(record.path), record.field
            if fields[place] == 1:
                # A folder for each pose: files that are the only one of their kind in theirs are of one series.
                own = alike[record.path.parent, kind] == 1
                source = _series_name(source) if own else (Path(source).parent / kind).as_posix()
                place = "" if place == "row" else place
            groups.setdefault((source, place, len(record.numbers)), []).append(record)
    return [
        Series(f"{source}:{place}" if place not in ("", "row") else source, records)
        for (source, whole, count), some in groups.items()
        for place, records in _kinds(whole, count, some)
    ]


def _kinds(place: str, count: int, records: list[PoseRecord]) -> list[tuple[str, list[PoseRecord]]]:
    """Records of one place, those that hold several kinds of poses taken apart.

    Of one picture there may be link1 to link8, and only one is the flange. Twelve numbers that are no matrix are two
    times six: joint angles and a pose, in either order.
    """
    kinds: dict[str, list[PoseRecord]] = {}
    if len({(r.path, r.label) for r in records}) < len(records):
        for record in records:
            kinds.setdefault(record.exact, []).append(record)
    if len(kinds) > 1:
        return list(kinds.items())
    if count != 12:
        return [(place, records)]
    return [
        (f"{place}/{name}".removeprefix("row/").lstrip("/"), [replace(r, numbers=r.numbers[half]) for r in records])
        for half, name in ((slice(0, 6), "numbers1-6"), (slice(6, 12), "numbers7-12"))
    ]


def match_series(
    series: Sequence[Series], listing: Listing, links: Sequence[dict[str, str]]
) -> tuple[list[Series], list[tuple[str, str]]]:
    """The series that belong to pictures, and the names of the others with the reason. Raises ConfigError for a folder
    with several recordings in it."""
    names = [listing.name(p) for p in listing.pictures]
    linked: dict[str, int] = {}
    for link in links:
        shown = [names.index(v) for v in link.values() if v in names]
        others = [v for v in link.values() if v not in names]
        if len(shown) == len(others) == 1:
            linked[others[0]] = shown[0]
    for one in series:
        _match_pictures(one, listing, linked)
    belonging = [s for s in (*series, *_in_order(series, len(names))) if s.of]
    if below := _others(belonging, listing):
        # The folder's own recording is meant; those in its sub-folders have boards and bases of their own.
        listing.pictures = [p for p in listing.pictures if p.parent not in below]
        listing.unread += [(f"{listing.name(p)}/", "a recording of its own: name it with --from") for p in below]
        return match_series([s for s in series if not any(r.path.parent in below for r in s.records)], listing, links)
    why = f"poses for {len(names)} pictures, and none says which picture it belongs to"
    return belonging, [(s.name, f"{len(s.records)} {why}") for s in series if not s.of and names]


def _in_order(series: Sequence[Series], pictures: int) -> Iterator[Series]:
    """Series by their order, of as many poses as pictures, whose numbers fit some of these only. One may count from 0
    and the other from 1: all but one fit, and each picture would get its neighbour's pose."""
    for one in series:
        if one.by in ("name", "number") and len(one.records) == pictures > len(one.of):
            yield replace(one, by="order", of=dict(enumerate(one.records)), alone=[])


def _match_pictures(one: Series, listing: Listing, linked: dict[str, int]) -> None:
    """Find the picture of each record: as a table `linked` files and pictures, or by what both are called."""
    single = len({r.path for r in one.records}) == len(one.records)
    labels = _labels(one, listing, single)
    which = list(range(len(listing.pictures)))
    found = _by_table(labels, linked)
    if not single or len(found.of) < LEAST:
        beside = {r.path.parent for r in one.records if single}
        which = [k for k in which if listing.pictures[k].parent in beside] or which
        found = _match([listing.name(listing.pictures[k]) for k in which], labels, [r.time for r in one.records])
    one.by, one.of = found.by, {which[k]: one.records[i] for k, i in found.of.items()}
    one.alone = [one.records[i] for i in found.alone]
    several = {which[k]: [one.records[i] for i in hits] for k, hits in found.doubled.items()}
    one.of |= {k: records[0] for k, records in several.items() if _are_one(records)}
    one.doubled = {k: records for k, records in several.items() if k not in one.of}


def _are_one(records: Sequence[PoseRecord]) -> bool:
    """Whether it is the same row again."""
    return all(np.array_equal(record.numbers, records[0].numbers) for record in records)


def _labels(one: Series, listing: Listing, single: bool) -> list[str]:
    """What each record is called: its file where it is alone in it, else what the file calls it."""
    return [listing.name(r.path) if single else r.label or "" for r in one.records]


def in_order_of_views(one: Series, frames: Sequence[RecordedFrame]) -> bool:
    """Give poses that name no picture to those that are left, in order, where there are as many; True where there are.
    What is left are no copies, and none of another size: drawn or straightened pictures lie beside at times."""
    left = [k for k, f in enumerate(frames) if f.shows is None and f.reason not in ASIDE]
    if len(left) != len(one.records):
        return False
    one.by, one.of, one.alone = "order", dict(zip(left, one.records, strict=True)), []
    return True


def _others(series: Sequence[Series], listing: Listing) -> list[Path]:
    """Sub-folders that are recordings of their own, where the folder itself is one, too. Raises ConfigError where it is
    none: their boards and bases need not be the same."""
    folders = [{listing.pictures[k].parent for k in one.of} for one in series if len(one.of) >= LEAST_ALONE]
    owners = {path for some in folders if len(some) == 1 for path in some}
    if len(owners) > 1 and listing.folder not in owners:
        raise ConfigError(
            f"{listing.folder} holds {len(owners)} recordings, each with poses of its own: "
            f"{', '.join(sorted(map(listing.name, owners)))}; give one of these folders with --from"
        )
    return sorted(owners - {listing.folder}) if len(owners) > 1 else []


@dataclass(frozen=True)
class _Match:
    """Which label belongs to which picture, by their indices; labels of none, and pictures that have several."""

    by: str
    of: dict[int, int]
    alone: list[int]
    doubled: dict[int, list[int]] = field(default_factory=dict)


def _by_table(labels: Sequence[str], linked: dict[str, int]) -> _Match:
    """The label of each picture that a table names with it."""
    of = {linked[label]: k for k, label in enumerate(labels) if label in linked}
    return _Match("table", of, [k for k, label in enumerate(labels) if label not in linked])


def _match(pictures: Sequence[str], labels: Sequence[str], times: Sequence[float | None]) -> _Match:
    """The label that belongs to each picture (names below the folder); the first way that serves most of them."""
    both = pictures, [label.replace("\\", "/") for label in labels]
    # The last is that of a folder for each pose.
    named = (str, lambda name: Path(name).name, _stem, frame_key, _folder)
    ways = [("folder" if way is _folder else "name", [list(map(way, side)) for side in both]) for way in named]
    if not any(label.startswith("[") for label in labels):
        ways.append(("number", [_numbers(side) for side in both]))
    best = max((_equal(left, right, by) for by, (left, right) in ways), key=lambda found: len(found.of))
    by_time = _nearest(pictures, labels, times) if len(best.of) < len(pictures) / 2 else None
    if by_time is None and len(labels) == len(pictures) and len(best.of) < 2:
        return _Match("order", {k: k for k in range(len(labels))}, [])
    return by_time or best


def _equal(left: list[str], right: list[str], by: str) -> _Match:
    many: dict[str, list[int]] = {}
    for k, key in enumerate(right):
        if key:
            many.setdefault(key, []).append(k)
    taken = Counter(left)
    hits = {k: many[key] for k, key in enumerate(left) if key in many}
    of = {k: h[0] for k, h in hits.items() if len(h) == 1 and (taken[left[k]] == 1 or by != "name")}
    doubled = {k: h for k, h in hits.items() if len(h) > 1}
    used = {*of.values(), *(i for h in doubled.values() for i in h)}
    return _Match(by, of, [k for k in range(len(right)) if k not in used], doubled)


def _numbers(names: Sequence[str]) -> list[str]:
    """The numbers in each name that differ from name to name, as one word; empty where there is none."""
    found = [[int(d) for d in re.findall(r"\d+", str(Path(n).with_suffix("")) if "." in n else n)] for n in names]
    length = Counter(map(len, found)).most_common(1)[0][0] if found else 0
    usual = [f for f in found if len(f) == length]
    varying = [k for k, column in enumerate(zip(*usual, strict=True)) if len(set(column)) > 1]
    varying = varying or list(range(length))[-1:]
    # A folder's number that goes with the file's adds nothing.
    if varying and len({f[varying[-1]] for f in usual}) == len(usual):
        varying = varying[-1:]
    return ["-".join(str(f[k]) for k in varying) if len(f) == length else "" for f in found]


def _nearest(pictures: Sequence[str], labels: Sequence[str], times: Sequence[float | None]) -> _Match | None:
    """The pose of the nearest time, where names and table have times of the same clock."""
    shown = np.array([_clock(Path(name).name) for name in pictures])
    own = np.array([math.nan if time is None else time for time in times])
    told = np.where(np.isfinite(own), own, [_clock(label) for label in labels])
    timed = np.flatnonzero(np.isfinite(told))
    if len(timed) < 2 or 2 * len(timed) < len(told) or not np.isfinite(shown).all():
        return None
    for scale in (1.0, 1e-3, 1e-6, 1e-9):
        clock = shown * scale
        apart = np.abs(clock[:, None] - told[timed])
        near, reach = apart.argmin(axis=1), 0.5 * float(np.median(np.diff(np.sort(clock)))) if len(clock) > 1 else 0.1
        good = apart.min(axis=1) <= max(reach, 1e-3)
        if good.mean() > 0.5 and len(set(near[good].tolist())) == int(good.sum()):
            of = {k: int(timed[near[k]]) for k in np.flatnonzero(good).tolist()}
            return _Match("time", of, [k for k in range(len(labels)) if k not in of.values()])
    return None


def _folder(name: str) -> str:
    return str(Path(name).parent)


def _stem(name: str) -> str:
    path = Path(name)
    return path.stem if path.suffix.lower() in (*PICTURES, *TEXTS) else path.name


def _clock(name: str) -> float:
    """The time in a name, NaN where there is none."""
    found = CLOCK.search(name)
    return math.nan if found is None else float(found[0].replace("_", "."))


def _series_name(name: str) -> str:
    """A file's name with its numbers taken out: files of one series have the same."""
    return re.sub(r"\d+", "N", name.lstrip("_"))


def frame_key(name: str) -> str:
    """What two pictures of one frame have in common: their name without folders and the words for what is in them."""
    words = re.split(r"[\s_\-.()]+|(?<=[a-z])(?=\d)", _stem(name).lower())
    return "-".join(str(int(w)) if w.isdecimal() else w for w in words if w and not re.fullmatch(ROLES, w))
