"""What a run's perception was given and what it made of it, to the last digit: `perception.json` in the run's folder.

With the frames, `sweep.npz`, job, configuration and calibration beside it, `cell.run.record.replay` does it all again.
"""

from __future__ import annotations

import hashlib
import json
import logging
from pathlib import Path
from typing import Any

from cell.measure.inversion import PlacePose
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.steps.reconstruct import Reconstruction
from cell.procedures.sweep.sweep_record import SweepRecord
from cell.run.files.folder import write_json
from drivers.errors import CellError, ConfigError, RefusedError
from statemachine.runner import RunResult

FILE, CLOUD = "perception.json", "cloud.ply"
FORMAT = 1
REPLAYED = ("reconstruct", "invert_pose")
"""Steps that are done again, so that their refusal is, too."""

log = logging.getLogger(__name__)


def save(folder: Path, result: RunResult) -> None:
    """Keep it for a run that came as far as its cloud, or was refused there; a disk that takes none is only told."""
    made = {type(value): value for value in result.results.values()}
    fix = made.get(BoardFix)
    failed = next((step.name for step in result.steps if step.state == "failed"), None)
    refused = failed in REPLAYED and isinstance(result.error, RefusedError)
    sweep, scan = made.get(SweepRecord), made.get(Reconstruction)
    if not isinstance(fix, BoardFix) or not isinstance(sweep, SweepRecord) or not (scan or refused):
        return
    data: dict[str, Any] = {
        "format": FORMAT,
        "photograph": {
            "files": [f"board-{fix.number:02d}-{frame.frame_id:06d}.png" for frame in fix.frames],
            "flange": fix.flange.tolist(),
            "base_from_board": fix.base_from_board.homogeneous.tolist(),
            "covariance": fix.covariance.tolist(),
        },
        "earlier_sweep": sweep.earlier,
        "cloud_sha256": sha256(folder / CLOUD),
        "points_sha256": None if not isinstance(scan, Reconstruction) else of_points(scan),
        "pose": None,
        "refused": {"step": failed, "reason": str(result.error)} if refused else None,
    }
    if isinstance(pose := made.get(PlacePose), PlacePose):
        data["pose"] = {
            "base_from_surface": pose.base_from_surface.homogeneous.tolist(),
            "covariance": pose.covariance.tolist(),
        }
    try:
        write_json(folder / FILE, data)
    except (CellError, OSError) as error:
        log.warning("%s is not kept, this run cannot be replayed: %s", FILE, error)


def load(folder: Path) -> dict[str, Any]:
    """What was kept; `ConfigError` when there is nothing to do again, `CellError` for a file that is none of ours."""
    path = folder / FILE
    if not path.exists():
        raise ConfigError(
            f"{folder.name} cannot be replayed: it holds no {FILE}. It did not come as far as a cloud, was no job, or "
            "was made by an older version; `cell report` says how it ended"
        )
    try:
        data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != FORMAT:
            raise ValueError(f"format {data['format']}, this program reads {FORMAT}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CellError(f"{path} cannot be read: {error}") from error
    return data


def of_points(scan: Reconstruction) -> str:
    """SHA-256 of a cloud's points with all their digits, of which the file keeps seven."""
    return hashlib.sha256(scan.cloud.points.tobytes()).hexdigest()


def sha256(path: Path) -> str | None:
    """Of a file's bytes; None where there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else None
