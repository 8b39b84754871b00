"""Series of recorded poses: files of one kind, or the rows of one table, and the picture that each belongs to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.conventions import Reading
from cell.calibration.recorded.listing import Listing
from cell.calibration.recorded.matching import match, series_name
from cell.calibration.recorded.texts import NEEDED, Content, Record, join_halves, read_content
from cell.vision.pictures import Reason
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from cell.calibration.recorded.folder import RecordedFrame

LEAST = 2
# Pictures that are no view of their own.
ASIDE = (Reason.DUPLICATE, Reason.WRONG_SIZE, Reason.LASER_PICTURE, Reason.UNREADABLE)
# A table whose rows are poses holds so many different rows.
LEAST_ALONE = 3


@dataclass(eq=False)
class Series:
    """Records of one kind, and in `of` the record of each picture by the picture's index; `by` says how they match."""

    name: str
    records: list[Record]
    of: dict[int, Record] = field(default_factory=dict)
    by: str = ""
    alone: list[Record] = field(default_factory=list)
    doubled: dict[int, list[Record]] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Numbers of a pose."""
        return len(self.records[0].numbers)

    @property
    def named(self) -> str:
        """What names beside the numbers said, see `Record`."""
        return self.records[0].named

    def poses(self, reading: Reading) -> dict[int, pin.SE3]:
        """Poses by picture in the unit of the file, without those that the reading makes no pose of."""
        found = {}
        for k, record in self.of.items():
            if not np.isfinite(record.numbers).all():
                continue
            try:
                found[k] = reading.pose(record.numbers)
            except ValueError:
                continue
        return found


def read_series(listing: Listing) -> tuple[list[Series], list[dict[str, str]], list[tuple[str, str]]]:
    """All series of a folder, the links between its files, and the texts that could not be read, with the reason."""
    contents: dict[str, Content] = {}
    unread: list[tuple[str, str]] = []
    for path in listing.texts:
        name = listing.name(path)
        try:
            contents[name] = read_content(path)
        except ValueError as error:
            unread.append((name, str(error)))
        except Exception as error:
            # Whatever a stray file holds, and whichever reader it upsets: the others are read all the same.
            unread.append((name, f"it cannot be read ({type(error).__name__}): {error}"))
    joined, paired = join_halves([half for content in contents.values() for half in content.halves])
    for name, content in contents.items():
        if not content.records and not content.links and not any(path in paired for path, _, _ in content.halves):
            what = (
                "positions or rotations only: name both files alike, such as R_gripper2base.txt and t_gripper2base.txt"
            )
            unread.append((name, f"it holds {what}" if content.halves else f"no pose is in it ({NEEDED} numbers)"))
    groups: dict[tuple[str, str, int], list[Record]] = {}
    for record in joined:
        groups.setdefault((listing.name(record.path), record.field, len(record.numbers)), []).append(record)
    alike = Counter((path.parent, series_name(path.name)) for path in listing.texts)
    for content in contents.values():
        for record in content.records:
            source, place = listing.name(record.path), record.field
            if sum(r.field == record.field for r in content.records) == 1:
                # A folder for each pose: files that are the only one of their kind in theirs are of one series.
                own = alike[record.path.parent, series_name(record.path.name)] == 1
                parent = listing.name(record.path.parent)
                source = series_name(source) if own else (Path(parent) / series_name(record.path.name)).as_posix()
                place = "" if place == "row" else place
            groups.setdefault((source, place, len(record.numbers)), []).append(record)
    found = [
        Series(f"{source}:{place}" if place not in ("", "row") else source, records)
        for (source, place), records in _apart(groups)
    ]
    links = [link for content in contents.values() for link in content.links]
    few = [s for s in found if len(s.records) < LEAST]
    unread += [(listing.name(s.records[0].path), "one pose, of a kind that no other file has") for s in few]
    return [s for s in found if len(s.records) >= LEAST], links, unread


def _apart(groups: dict[tuple[str, str, int], list[Record]]) -> list[tuple[tuple[str, str], list[Record]]]:
    """Groups of records by their source and place, those that hold several kinds of poses taken apart.

    Of one picture there may be link1 to link8, and only one is the flange. Twelve numbers that are no matrix are two
    times six: joint angles and a pose, in either order.
    """
    found: list[tuple[tuple[str, str], list[Record]]] = []
    for (source, place, count), records in groups.items():
        kinds: dict[str, list[Record]] = {}
        if len({(r.path, r.label) for r in records}) < len(records):
            for record in records:
                kinds.setdefault(record.exact, []).append(record)
        if len(kinds) > 1:
            found += [((source, kind), some) for kind, some in kinds.items()]
        elif count == 12:
            for half, name in ((slice(0, 6), "numbers1-6"), (slice(6, 12), "numbers7-12")):
                six = [replace(record, numbers=record.numbers[half]) for record in records]
                found.append(((source, f"{place}/{name}" if place not in ("", "row") else name), six))
        else:
            found.append(((source, place), records))
    return found


def match_series(
    series: Sequence[Series], listing: Listing, links: Sequence[dict[str, str]]
) -> tuple[list[Series], list[tuple[str, str]]]:
    """The series that belong to pictures, and the names of the others with the reason.

    Raises ConfigError for a folder with several recordings in it.
    """
    names = [listing.name(p) for p in listing.pictures]
    linked = _linked(names, links)
    for one in series:
        single = len({r.path for r in one.records}) == len(one.records)
        own = {r.path.parent for r in one.records}
        beside = [k for k, p in enumerate(listing.pictures) if p.parent in own] if single else []
        which = beside or list(range(len(names)))
        labels = [listing.name(r.path) if single else r.label for r in one.records]
        by_link = {label: k for k, label in linked.items()}
        if single and sum(label in by_link for label in labels) >= LEAST:
            one.by = "table"
            one.of = {by_link[label]: r for label, r in zip(labels, one.records, strict=True) if label in by_link}
            one.alone = [r for label, r in zip(labels, one.records, strict=True) if label not in by_link]
            continue
        found = match([names[k] for k in which], labels, [r.time for r in one.records])
        one.by = found.by
        one.of = {which[k]: one.records[i] for k, i in enumerate(found.of) if i is not None}
        one.alone = [one.records[i] for i in found.alone]
        one.doubled = {which[k]: [one.records[i] for i in hits] for k, hits in found.doubled.items()}
    belonging = [s for s in series if s.of]
    below = _others(belonging, listing)
    if below:
        # The folder's own recording is meant; those in its sub-folders have boards and bases of their own.
        listing.pictures = [p for p in listing.pictures if p.parent not in below]
        listing.unread += [(f"{listing.name(p)}/", "a recording of its own: name it with --from") for p in below]
        kept = [s for s in series if not any(r.path.parent in below for r in s.records)]
        return match_series(kept, listing, links)
    strange = [
        (s.name, f"{len(s.records)} poses for {len(names)} pictures, and none says which picture it belongs to")
        for s in series
        if not s.of
    ]
    return belonging, strange if names else []


def in_order_of_views(one: Series, frames: Sequence[RecordedFrame]) -> bool:
    """Give poses that name no picture to those that are left, in order, where there are as many; True where there are.

    What is left are no copies, and none of another size: drawn or straightened pictures lie beside at times.
    """
    left = [k for k, f in enumerate(frames) if f.shows is None and f.reason not in ASIDE]
    if len(left) != len(one.records):
        return False
    one.by, one.of, one.alone = "order", dict(zip(left, one.records, strict=True)), []
    return True


def _linked(names: Sequence[str], links: Sequence[dict[str, str]]) -> dict[int, str]:
    """Pose files that a table names beside a picture, by the picture's index."""
    found = {}
    for link in links:
        pictures = [names.index(v) for v in link.values() if v in names]
        others = [v for v in link.values() if v not in names]
        if len(pictures) == 1 and len(others) == 1:
            found[pictures[0]] = others[0]
    return found


def _others(series: Sequence[Series], listing: Listing) -> list[Path]:
    """Sub-folders that are recordings of their own, where the folder itself is one, too.

    Raises ConfigError where it is none: their boards and bases need not be the same.
    """
    owners: set[Path] = set()
    for one in series:
        folders = {listing.pictures[k].parent for k in one.of}
        if len(one.of) >= LEAST_ALONE and len(folders) == 1:
            owners |= folders
    if len(owners) > 1 and listing.folder not in owners:
        raise ConfigError(
            f"{listing.folder} holds {len(owners)} recordings, each with poses of its own: "
            f"{', '.join(sorted(map(listing.name, owners)))}; give one of these folders with --from"
        )
    return sorted(owners - {listing.folder}) if len(owners) > 1 else []
