"""Recorded frames on disk: pictures, the flange pose of each, what is seen in each, and why one is refused.

`frame0007.png` belongs to `pose0007.txt`: ((x, y, z) in m, (qx, qy, qz, qw)), or seven numbers, or a 4×4 matrix.
"""

from __future__ import annotations

import ast
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from cell.geometry.camera import Array
from cell.geometry.poses import from_matrix, from_quaternion
from cell.vision.board.board import find_board
from cell.vision.board.spec import BoardSpec
from cell.vision.board.view import BoardView
from cell.vision.pictures import Image, PictureRefused, Reason, read_picture
from cell.vision.stripe.extract import StripeProfile, extract
from drivers.errors import ConfigError

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
FARTHEST_M = 20.0

# A laser stripe is brighter than the board's white, and runs on from row to row.
LASER_OVER_WHITE = 1.2
LEAST_SMOOTH_ROWS = 30
LEAST_SMOOTH_SHARE = 0.05


@dataclass(eq=False)
class RecordedFrame:
    """One picture of a folder: what is seen in it, its pose, or `reason` and `text` why it is not used."""

    path: Path
    view: BoardView | None = None
    profile: StripeProfile | None = None
    base_from_flange: pin.SE3 | None = None
    reason: Reason | None = None
    text: str = ""

    @property
    def name(self) -> str:
        """What it is called in tables."""
        return self.path.name

    def refuse(self, reason: Reason, text: str) -> None:
        """Set the frame aside."""
        self.reason, self.text = reason, text


def read_frames(folder: Path, spec: BoardSpec) -> list[RecordedFrame]:
    """Every picture of a folder in the order of its number, with board, stripe and pose, or refused with a reason.

    Raises ConfigError when the folder does not exist or holds no pictures.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder; give the folder that holds the recorded frames")
    paths = sorted((p for p in folder.iterdir() if p.suffix.lower() in PICTURES), key=_natural)
    if not paths:
        raise ConfigError(f"{folder} holds no pictures ({', '.join(PICTURES)})")
    frames = [RecordedFrame(path) for path in paths]
    images: dict[Path, Image] = {}
    for frame in frames:
        try:
            images[frame.path] = read_picture(frame.path)
        except PictureRefused as refused:
            frame.refuse(refused.reason, str(refused))
    sizes = Counter((i.shape[1], i.shape[0]) for i in images.values())
    size = sizes.most_common(1)[0][0] if sizes else None
    for frame in frames:
        if frame.path not in images:
            continue
        try:
            frame.view = find_board(images[frame.path], spec, size)
            frame.profile = find_stripe(images[frame.path], frame.view)
        except PictureRefused as refused:
            frame.refuse(refused.reason, str(refused))
    for frame in frames:
        _attach_pose(frame)
    return frames


def find_stripe(image: Image, view: BoardView) -> StripeProfile | None:
    """The laser stripe of a picture along rows or columns, whichever it follows; None when there is no laser."""
    low, high = np.clip(view.pixels.min(axis=0), 0, None).astype(int), view.pixels.max(axis=0).astype(int) + 1
    white = float(np.percentile(image[low[1] : high[1], low[0] : high[0]], 75))
    best: tuple[int, StripeProfile] | None = None
    for axis in ("rows", "columns"):
        profile = extract(image, axis="rows" if axis == "rows" else "columns")
        if len(profile.rows) < LEAST_SMOOTH_ROWS:
            continue
        # Where three neighbouring rows have centres on a line, within a pixel.
        smooth = int(np.sum(np.abs(np.diff(profile.centres, 2)) < 1.0))
        at = np.round(profile.pixels()).astype(int)
        level = float(np.median(image[at[:, 1], at[:, 0]]))
        enough = smooth > max(LEAST_SMOOTH_ROWS, LEAST_SMOOTH_SHARE * len(profile.centres))
        if enough and level > min(LASER_OVER_WHITE * white + 5, 250) and (best is None or smooth > best[0]):
            best = smooth, profile
    return None if best is None else best[1]


def read_pose(path: Path) -> pin.SE3:
    """base_from_flange of a pose file. Raises ValueError that names the file and what is wrong with it."""
    text = path.read_text(encoding="utf-8", errors="replace").strip()
    try:
        data = ast.literal_eval(text) if text[:1] in "([" else [float(w) for w in re.split(r"[,\s]+", text)]
    except (ValueError, SyntaxError) as error:
        raise ValueError(f"{path.name} is not ((x, y, z), (qx, qy, qz, qw)): {text[:60]!r}") from error
    try:
        numbers = np.hstack([np.ravel(np.asarray(part, dtype=np.float64)) for part in data])
        if not np.isfinite(numbers).all():
            raise ValueError("it holds values that are not finite")
        if len(numbers) == 7:
            pose = from_quaternion(numbers[:3], numbers[3:])
        elif len(numbers) == 16:
            pose = from_matrix(numbers.reshape(4, 4))
        else:
            raise ValueError(f"it holds {len(numbers)} numbers, not 7 (position, quaternion) or 16 (4×4 matrix)")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path.name}: {error}") from error
    if np.linalg.norm(pose.translation) > FARTHEST_M:
        raise ValueError(
            f"{path.name}: the flange is {np.linalg.norm(pose.translation):.0f} m from the base; poses are in m, not mm"
        )
    return pose


def read_pose_pairs(folder: Path) -> list[tuple[pin.SE3, pin.SE3]]:
    """Pairs (base_from_flange, camera_from_board) from the folder's JSON files; empty when none holds such a list.

    Raises ConfigError for a list of pairs with a matrix that is no pose.
    """
    for path in sorted(folder.glob("*.json")):
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            pairs: Array = np.asarray(data, dtype=np.float64)
        except (ValueError, TypeError, OSError):
            continue
        if pairs.ndim != 4 or pairs.shape[1:] != (2, 4, 4):
            continue
        try:
            return [(from_matrix(a), from_matrix(b)) for a, b in pairs]
        except ValueError as error:
            raise ConfigError(f"{path}: {error}") from error
    return []


def poses_without_frame(folder: Path, frames: Sequence[RecordedFrame]) -> list[str]:
    """Names of the pose files that belong to no picture."""
    stems = {name for frame in frames for name in _pose_names(frame.path.stem)}
    return sorted(
        p.name for p in folder.glob("pose*") if p.suffix.lower() == ".txt" and p.is_file() and p.stem not in stems
    )


def used(frames: Sequence[RecordedFrame]) -> list[RecordedFrame]:
    """The frames that were not refused."""
    return [f for f in frames if f.reason is None and f.view is not None]


def _attach_pose(frame: RecordedFrame) -> None:
    """Give a frame the pose of its number; a broken pose file refuses the frame, a missing one does not."""
    for name in _pose_names(frame.path.stem):
        for suffix in (".txt", ".json"):
            path = frame.path.with_name(name + suffix)
            if not path.exists():
                continue
            try:
                frame.base_from_flange = read_pose(path)
            except (ValueError, OSError) as error:
                if frame.reason is None:
                    frame.refuse(Reason.NO_POSE, str(error))
            return


def _pose_names(stem: str) -> list[str]:
    """What the pose file of a picture may be called, without its ending."""
    return [re.sub(r"^.*?(\d+)$", r"pose\1", stem), f"{stem}_pose", stem]


def _natural(path: Path) -> list[object]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name.lower())]
