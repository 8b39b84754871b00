"""What lies in a recording's folder and its sub-folders: pictures, texts, and what is neither, by name."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path

from drivers.errors import ConfigError

from cell.calibration.recorded.texts import PICTURES

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
        real = os.path.realpath(root)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        for name in [f for f in folders if _hidden(f)]:
            folders.remove(name)
            listing.unread.append((listing.name(Path(root, name)) + "/", "hidden, not read"))
        for path in (Path(root, name) for name in files):
            reason = _why_not(path)
            if reason:
                listing.unread.append((listing.name(path), reason))
            else:
                (listing.pictures if path.suffix.lower() in PICTURES else listing.texts).append(path)
    listing.pictures.sort(key=lambda p: natural(listing.name(p)))
    listing.texts.sort(key=lambda p: natural(listing.name(p)))
    listing.unread.sort(key=lambda u: natural(u[0]))
    return listing


def natural(name: str) -> list[tuple[int, int, str]]:
    """A sort key in which frame10 follows frame9."""
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in re.split(r"(\d+)", name.lower()) if p]


def _hidden(name: str) -> bool:
    return name.startswith((".", "__MACOSX"))


def _why_not(path: Path) -> str:
    """Why a file is neither a picture nor a text that may be read; empty where it is."""
    suffix = path.suffix.lower()
    if _hidden(path.name):
        return "hidden, not read"
    if not path.exists():
        return "a link to a file that is not there"
    if not path.is_file():
        return "no ordinary file"
    if suffix in TEXTS and path.stat().st_size > LARGEST_TEXT:
        return f"{path.stat().st_size / 1e6:.0f} MB are too much for a table of poses"
    if suffix in (*PICTURES, *TEXTS):
        return ""
    return next((r for kinds, r in OTHERS.items() if suffix in kinds), "neither a picture nor a table that is known")
