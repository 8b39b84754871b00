"""The pictures of a run's page, small enough for one file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

MOST_EDGE = 900
"""Longer edge of a picture in px; a larger one is made smaller."""
QUALITY = 82
MOST_LAST = 6


@dataclass(frozen=True)
class Photograph:
    """A picture as JPEG and what it shows."""

    caption: str
    jpeg: bytes


def chosen(folder: Path, report: Mapping[str, Any]) -> list[tuple[Path, str]]:
    """Files and captions, the most telling first: what a run looked at that did not place, or what it measured with."""
    last = [str(name) for name in report.get("last_frames") or ()][-MOST_LAST:]
    if report.get("outcome") not in ("placed", "done"):
        seen = [(folder / name, "looked at last, before the run ended") for name in reversed(last)]
        drawn = [(folder / "picture.png", "what was found in the pictures, and why the run ended")]
        found = [(path, caption) for path, caption in [*drawn, *seen] if path.is_file()]
        return found if last else [*found, *_measured_with(folder / "frames")]
    return _measured_with(folder / "frames")


def _measured_with(frames: Path) -> list[tuple[Path, str]]:
    boards = sorted(frames.glob("board-*.png"))
    stripes = sorted(frames.glob("stripe-*.png"))
    picked = [(path, "the board, photographed last") for path in boards[-1:]]
    numbers = dict.fromkeys(len(stripes) * k // 4 for k in (2, 1, 3)) if stripes else {}
    return picked + [(stripes[k], f"the sweep, frame {k + 1} of {len(stripes)}") for k in numbers]


def photograph(path: Path, caption: str) -> Photograph | None:
    """The picture in `path`, at most `MOST_EDGE` px long; None for a file that is no picture (any more)."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR if path.name == "picture.png" else cv2.IMREAD_GRAYSCALE)
    if image is None:
        return None
    # The drawn picture has small letters: it keeps its size.
    share = 1.0 if path.name == "picture.png" else MOST_EDGE / max(image.shape[:2])
    if share < 1.0:
        image = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    return Photograph(f"{path.name}: {caption}", data.tobytes()) if done else None
