"""Perception once more, from what a run kept: the same pictures and readings have to give the same cloud and pose.

The run's folder is the truth: its PNG files, `sweep.npz` (where the scan head was at each line), job, configuration and
calibration, and `perception.json` with the flange at the photograph and what came of it, to the last digit. The
pictures in `record.mcap` have to be the same bytes. Everything is compared bit for bit: a difference means other code,
other libraries, or changed files.
"""

import hashlib
import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pinocchio as pin

from cell.base.storage import read_json, write_json
from cell.base.toml_file import restored
from cell.config.calibrations.store import read_calibration
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.devices.assembly import behind_gate
from cell.measure.geometry.poses import difference, from_matrix
from cell.measure.inversion import NominalSurface, PlacePose
from cell.measure.reconstruction.ply import read_cloud
from cell.procedures.arm.photograph import BoardFix, photograph
from cell.procedures.drive.way import Whereabouts
from cell.procedures.frame_store import FrameStore
from cell.procedures.sought_part import nominal_of
from cell.procedures.steps.board_photo import settled
from cell.procedures.steps.invert_pose import inverted
from cell.procedures.steps.reconstruct import Reconstruction, reconstructed
from cell.procedures.steps.workplace import Workplace
from cell.procedures.sweep.stored_sweep import StoredSweep, SweepRecord
from cell.run.record.file import FILE as RECORD
from cell.run.record.reading import messages
from drivers.camera.folder import read_image
from drivers.clock import Clock
from drivers.errors import CellError, ConfigError, RefusedError
from drivers.interfaces import Arm, ArmSafety, ArmState, Camera, Frame, Vehicle
from statemachine.journal import JournalError, read
from statemachine.runner import RunResult

FILE, CLOUD = "perception.json", "cloud.ply"
FORMAT = 1
KEYS = frozenset({"earlier_sweep", "cloud_sha256", "points_sha256", "pose", "refused"})
KEYS_OF_PHOTOGRAPH = frozenset({"files", "flange", "base_from_board", "covariance"})
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
    data: dict[str, object] = {
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
        data = read_json(path).content
        if data["format"] != FORMAT:
            raise ValueError(f"format {data['format']}, this program reads {FORMAT}")
        for part, keys in ((data, KEYS), (data["photograph"], KEYS_OF_PHOTOGRAPH)):
            if not isinstance(part, dict) or not keys <= part.keys():
                raise ValueError(f"it has not all of {', '.join(sorted(keys))}")
    except (OSError, ValueError, KeyError) as error:
        raise CellError(f"{path} cannot be read: {error}") from error
    if not (folder / "frames").is_dir():
        raise ConfigError(
            f"{folder.name} cannot be replayed: it kept no pictures. Set cell.frames = true, then run the job again"
        )
    return data


def of_points(scan: Reconstruction) -> str:
    """SHA-256 of a cloud's points with all their digits, of which the file keeps seven."""
    return hashlib.sha256(scan.cloud.points.tobytes()).hexdigest()


def sha256(path: Path) -> str | None:
    """Of a file's bytes; None where there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else None


Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Compared:
    """One thing that was made again: `difference` says how far it is from what the run made, "" where not at all."""

    what: str
    difference: str

    @property
    def same(self) -> bool:
        """Bit for bit."""
        return not self.difference


def replay(folder: Path, progress: Progress = lambda fraction, text: None) -> list[Compared]:
    """Do it again and compare. `ConfigError` when the run cannot be replayed, `CellError` for a file that is broken."""
    kept = load(folder)
    config, job = restored(CellConfig, folder / "configuration.json"), restored(Job, folder / "job.json")
    calibration = read_calibration(folder / "calibration.json")
    nominal = _nominal(folder, job)
    with tempfile.TemporaryDirectory(prefix="cell-replay-") as name, FrameStore(Path(name) / "frames") as frames:
        nobody = behind_gate(config, Clock())
        workplace = Workplace(
            config, job, nominal, calibration=calibration, devices=nobody, frames=frames, folder=Path(name),
            whereabouts=Whereabouts(cast(Vehicle, None))
        )  # fmt: skip
        progress(0.05, "photograph")
        told = kept["photograph"]
        camera = workplace.calibration.target.camera
        seen = _Kept(folder, told, (camera.height, camera.width))
        fix = photograph(
            cast(Arm, seen), cast(Camera, seen), workplace.calibration.target, spec=workplace.board,
            limits=workplace.job.photo, repeatability=workplace.repeatability, count=len(told["files"]),
        )  # fmt: skip
        fix = settled(fix, workplace.config.arm.vehicle_from_base.se3().inverse())
        off = pose_difference(fix.base_from_board, told["base_from_board"])
        compared = [Compared("board's pose", off or _array_difference(fix.covariance, told["covariance"]))]
        progress(0.15, "sweep")
        head, exit_point = workplace.calibration.scan, workplace.config.laser.exit_point
        # What was changed comes out otherwise, which is what a replay is to show.
        stored = StoredSweep.load(folder, head, workplace.job.scan, exit_point, as_written=False)
        sweep = stored.confirmed_by(fix) if kept["earlier_sweep"] else stored.sweep
        compared += _perceive(workplace, folder, kept, sweep=sweep, fix=fix, progress=progress)
    progress(0.95, "pictures of the record")
    return compared + _pictures(folder)


def _nominal(folder: Path, job: Job) -> NominalSurface:
    try:
        mesh = read(folder).run.info["mesh"]
        path, expected = Path(mesh["file"]), mesh["sha256"]
    except (JournalError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{folder.name} cannot be replayed: its journal does not name a surface ({error})") from error
    if sha256(path) != expected:
        raise ConfigError(f"{folder.name} cannot be replayed: its surface {path} is gone or was changed since")
    return nominal_of(job, path)


class _Kept:
    """An arm and a camera that tell what those of the run told."""

    def __init__(self, folder: Path, told: dict[str, Any], shape: tuple[int, int]) -> None:
        self._flange = np.array(told["flange"])
        self._files = [folder / "frames" / name for name in told["files"]]
        self._shape = shape
        self._next = 0

    def state(self, max_age: float = 0.1) -> ArmState:
        nothing = np.zeros(6)
        return ArmState(
            0.0, nothing, nothing, flange=self._flange, wrench=nothing, safety=ArmSafety.NORMAL, moving=False,
            digital_inputs=0, digital_outputs=0,
        )  # fmt: skip

    def grab(self, timeout: float = 2.0) -> Frame:
        path = self._files[self._next]
        self._next += 1
        return Frame(read_image(path, self._shape), self._next, 0.0, device_time=0.0, host_time=0.0, received=0.0)


def _perceive(
    workplace: Workplace, folder: Path, kept: dict[str, Any], sweep: SweepRecord, fix: BoardFix, progress: Progress
) -> list[Compared]:
    compared = []
    refused: dict[str, str] | None = None
    scan = pose = None
    step = REPLAYED[0]
    try:
        progress(0.5, step)
        scan = reconstructed(workplace, sweep)
        step = REPLAYED[1]
        if kept["pose"] is not None or kept["refused"] is not None:
            progress(0.6, step)
            pose = inverted(workplace, sweep, scan, fix)
    except RefusedError as error:
        refused = {"step": step, "reason": str(error)}
    cloud = _cloud_difference(folder, workplace.folder, kept["cloud_sha256"])
    if not cloud and scan is not None and of_points(scan) != kept["points_sha256"]:
        cloud = "the same to single precision only"
    compared.append(Compared("cloud", cloud))
    if kept["refused"] is not None or refused is not None:
        same = kept["refused"] == refused
        compared.append(Compared("refusal", "" if same else f"{_refusal(kept['refused'])}; now {_refusal(refused)}"))
    if pose is not None and kept["pose"] is not None:
        found = pose.base_from_surface
        compared.append(Compared("place pose", pose_difference(found, kept["pose"]["base_from_surface"])))
        compared.append(Compared("its covariance", _array_difference(pose.covariance, kept["pose"]["covariance"])))
    return compared


def _refusal(refused: dict[str, str] | None) -> str:
    return "it was not refused" if refused is None else f"{refused['step']} refused: {refused['reason']}"


def pose_difference(found: pin.SE3, told: list[list[float]]) -> str:
    """How far a pose is from a matrix (4, 4), "" for the same bits."""
    if np.array_equal(found.homogeneous, np.array(told)):
        return ""
    off = difference(found, from_matrix(np.array(told)))
    return f"off by {1e3 * np.linalg.norm(off[:3]):.3g} mm and {1e3 * np.linalg.norm(off[3:]):.3g} mrad"


def _array_difference(found: Any, told: Any) -> str:
    before = np.array(told)
    if np.array_equal(found, before):
        return ""
    return f"off by up to {100 * np.abs(found - before).max() / np.abs(before).max():.3g} % of its largest figure"


def _cloud_difference(folder: Path, again: Path, expected: str | None) -> str:
    before, now = folder / CLOUD, again / CLOUD
    if sha256(before) != expected:
        return f"{before} was changed since the run wrote it"
    if sha256(now) == expected:
        return ""
    clouds = [read_cloud(path).points if path.exists() else np.empty((0, 3)) for path in (before, now)]
    if len(clouds[0]) != len(clouds[1]):
        return f"{len(clouds[0])} points; now {len(clouds[1])}"
    off = np.linalg.norm(clouds[0] - clouds[1], axis=1)
    if not off.any():
        return "the same points, written otherwise"
    return f"{np.count_nonzero(off)} of {len(off)} points are elsewhere, up to {1e3 * off.max():.3g} mm"


def _pictures(folder: Path) -> list[Compared]:
    """The pictures in the record against the files."""
    path = folder / RECORD
    if not path.exists():
        return []
    names: dict[tuple[str, int], str] = {}
    count, other = 0, []
    for topic, at, message in messages(path, ("/scan_camera/", "/target_camera/")):
        device, what = topic.strip("/").split("/")
        if what == "frame":
            names[device, at] = message["file"]
        elif what == "image":
            name = names.get((device, at), "")
            file = folder / "frames" / name
            count += 1
            if not name or not file.is_file() or file.read_bytes() != message.data:
                other.append(name or f"{device} at {at} ns")
    listed = ", ".join(other[:3]) + (" …" if len(other) > 3 else "")
    return [Compared(f"{count} pictures of the record", f"not those in frames/: {listed}" if other else "")]
