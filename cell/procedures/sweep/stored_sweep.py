"""What a sweep brought, and that on the disk: so that a run can be resumed without sweeping again.

The frames are the run's PNG files, from which the stripe is extracted again. A stored sweep holds only as long as arm
base and station have not moved against each other, which a new photograph of the board must confirm.
"""

import hashlib
import shutil
import zipfile
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from cell.base.storage import DIGEST, replacing, require_unchanged, sealed_arrays, sync_files
from cell.config.calibrations.store import require_covariance
from cell.config.job import ScanSection
from cell.measure.calibration import ScanCalibration
from cell.measure.calibration.drift.reference_plate import Pointing
from cell.measure.calibration.drift.slip import Slip
from cell.measure.geometry.poses import difference, from_matrix
from cell.measure.reconstruction.build import ScanGeometry
from cell.measure.vision.stripe.profile import StripeProfile
from cell.procedures.ambient import REACHES
from cell.procedures.arm.photograph import MOVED, BoardFix
from cell.procedures.sweep.swath import Swath, SweepCollector
from drivers.camera.folder import read_image
from drivers.errors import CalibrationStale, CellError, RefusedError
from drivers.interfaces import ArmMotion, Frame, Vector


@dataclass(frozen=True, eq=False)
class SweepRecord:
    """What the sweeps brought, in their order; at least one.

    `pointing` of the laser and `slip` of the head, where a witness told them; `doubts` for people; `earlier` names the
    run that swept, where it was another one. `rest` is the motion that brought the arm to where it stood meanwhile.
    `back` is the look at the last strip on the way back, None where nobody looked, and for `held_s` the run had been
    held by then. So many seconds before, `looked_s`, the witness was looked at for a part before this one; 0 for this.
    """

    swaths: tuple[Swath, ...]
    pointing: Pointing | None = None
    doubts: tuple[str, ...] = ()
    slip: Slip | None = None
    earlier: str = ""
    rest: ArmMotion | None = None
    back: "SweepRecord | None" = None
    held_s: float = 0.0
    looked_s: float = 0.0

    @property
    def base_from_flange(self) -> pin.SE3:
        """Where the flange was half-way through the first sweep."""
        return self.swaths[0].base_from_flange

    @property
    def times(self) -> Vector:
        """When each line was taken, sweep after sweep, s."""
        return np.concatenate([swath.times for swath in self.swaths])

    @property
    def middle(self) -> Frame:
        """The frame from the middle of the first sweep."""
        return self.swaths[0].middle

    @property
    def middle_profile(self) -> StripeProfile:
        """The stripe in `middle`."""
        return self.swaths[0].middle_profile

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not as usual, for people."""
        turned = self.pointing.notes if self.pointing is not None else ()
        return (*turned, *(() if self.slip is None else self.slip.notes), *self.doubts)

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "sweeps": len(self.swaths),
            "profiles": sum(len(swath.lines) for swath in self.swaths),
            "lost_frames": sum(swath.lost for swath in self.swaths),
            "points": sum(swath.points for swath in self.swaths),
            "residual_um": [round(1e6 * swath.residual, 2) for swath in self.swaths],
            "laser_turned_mrad": None if self.pointing is None else round(1e3 * self.pointing.turn, 4),
            "laser_confirmed_mrad": None if self.pointing is None else round(1e3 * self.pointing.confirmed, 4),
            "head_slipped_um": None if self.slip is None else [round(1e6 * v, 1) for v in self.slip.shift],
            "pictures_later_ms": None if self.slip is None else round(1e3 * self.slip.lag, 2),
            **({"head_looked_s_ago": round(self.looked_s, 1)} if self.looked_s else {}),
            "time_shift_um": [round(1e6 * swath.shift, 2) for swath in self.swaths],
        }


FILE = "sweep.npz"
FORMAT = 5

_ARRAYS = ("lines", "frame_ids", "times", "flanges", "rail", "line_spread", "covariance", "seen")


def frame_path(folder: Path, frame_id: int) -> Path:
    """Where the run in `folder` keeps the frame `frame_id` of its sweep."""
    return folder / "frames" / f"stripe-{frame_id:06d}.png"


def save_sweep(folder: Path, sweep: SweepRecord, fix: BoardFix, frames: Mapping[str, str] = {}) -> None:
    """Write what a sweep was taken with, and where the board was seen before it, into the run's `folder`. `frames` are
    the SHA-256 of the frames' files by name; each is one that is on the disk."""
    data: dict[str, Any] = {
        "format": np.array(FORMAT),
        "base_from_board": fix.base_from_board.homogeneous,
        "board_covariance": fix.covariance, "doubts": np.array(sweep.doubts, dtype=np.str_),
    }  # fmt: skip
    if sweep.pointing is not None:
        data["pointing"] = np.array(astuple(sweep.pointing))
    if sweep.slip is not None:
        data["slip"] = np.array(
            [*sweep.slip.shift, sweep.slip.lag, sweep.slip.depth, sweep.slip.hidden], dtype=np.float64
        )
    for k, swath in enumerate(sweep.swaths):
        data |= {f"{name}_{k}": getattr(swath, name) for name in _ARRAYS}
        data[f"figures_{k}"] = np.array([swath.lost, swath.residual, swath.shift])
        names = [frame_path(folder, int(frame_id)).name for frame_id in swath.seen]
        data[f"frames_{k}"] = np.array([frames.get(name, "") for name in names], dtype=np.str_)
    data[DIGEST] = np.array(sealed_arrays(data))
    with replacing(folder / FILE) as file:
        np.savez(file, **data)


@dataclass(frozen=True, eq=False)
class StoredSweep:
    """The sweep of the run in `folder`, and the board's pose (covariance (6, 6), base axes) that belongs to it."""

    folder: Path
    sweep: SweepRecord
    base_from_board: pin.SE3
    board_covariance: Vector

    @classmethod
    def load(
        cls, folder: Path, head: ScanCalibration, scan: ScanSection, exit_point: Vector, *, as_written: bool = True
    ) -> "StoredSweep":
        """Read it, and extract the stripe from the frames again. `RefusedError` when anything of it is missing, no
        number, or, with `as_written`, was changed: a figure or a frame."""
        path = folder / FILE
        try:
            with np.load(path, allow_pickle=False) as data:
                stored = {name: data[name] for name in data.files}
            if stored["format"] != FORMAT:
                raise ValueError(f"format {stored['format']}, this program reads {FORMAT}")
            if as_written:
                require_unchanged(stored)
            pointing = Pointing(*map(float, stored["pointing"])) if "pointing" in stored else None
            slip = _slip(*map(float, stored["slip"])) if "slip" in stored else None
            geometry = (head if pointing is None else head.pointed(pointing, exit_point)).geometry()
            count = sum(name.startswith("frame_ids_") for name in stored)
            if as_written:
                _require_frames(folder, stored, count)
            swaths = tuple(_swath(folder, stored, k, geometry, scan) for k in range(count))
            if not swaths:
                raise ValueError("it holds no sweep")
            base_from_board, covariance = from_matrix(stored["base_from_board"]), stored["board_covariance"]
            require_covariance("board_covariance", covariance.reshape(6, 6), range(0))
        except (OSError, ValueError, KeyError, EOFError, TypeError, IndexError, zipfile.BadZipFile, CellError) as error:
            raise RefusedError(f"{path} cannot be read as a sweep: {error}") from error
        doubts = tuple(map(str, stored.get("doubts", ())))
        return cls(folder, SweepRecord(swaths, pointing, doubts, slip), base_from_board, covariance)

    def confirmed_by(self, fix: BoardFix) -> SweepRecord:
        """The sweep, if the board stands where it stood; its covariance holds what two photographs leave open. Raises
        `CalibrationStale` when the board is seen elsewhere: then the sweep says nothing any more."""
        moved = moved_by(fix, self.base_from_board, self.board_covariance)
        if moved is not None:
            raise CalibrationStale(f"the board has moved by {moved} since the sweep of run {self.folder.name}")
        spread = fix.covariance + self.board_covariance
        swaths = tuple(self._loosened(swath, spread) for swath in self.sweep.swaths)
        return replace(self.sweep, swaths=swaths, earlier=self.folder.name)

    def _loosened(self, swath: Swath, spread: Vector) -> Swath:
        """With the motion that may have gone unnoticed, (6, 6) at the board's origin, added to the flange's pose."""
        carried = np.eye(6)
        carried[:3, 3:] = -pin.skew(swath.base_from_flange.translation - self.base_from_board.translation)
        return replace(swath, covariance=swath.covariance + carried @ spread @ carried.T)

    def copy_to(self, folder: Path) -> None:
        """Let the run in `folder` hold the sweep too, so that it can be resumed in its turn."""
        (folder / "frames").mkdir(parents=True, exist_ok=True)
        for swath in self.sweep.swaths:
            for frame_id in swath.seen:
                shutil.copyfile(frame_path(self.folder, frame_id), frame_path(folder, frame_id))
        sync_files(folder)
        with replacing(folder / FILE) as file:
            file.write((self.folder / FILE).read_bytes())


def moved_by(fix: BoardFix, base_from_board: pin.SE3, covariance: Vector) -> str | None:
    """How far the board is seen from where it was, in words; None while that is within what two photographs differ."""
    moved = difference(fix.base_from_board, base_from_board)
    if float(moved @ np.linalg.solve(fix.covariance + covariance, moved)) <= MOVED:
        return None
    return f"{1e3 * np.linalg.norm(moved[:3]):.2f} mm and {np.degrees(np.linalg.norm(moved[3:])):.3f} deg"


def _slip(along: float, across: float, lag: float, depth: float, hidden: float) -> Slip:
    return Slip(along, across, lag, bool(hidden), depth)


def _require_frames(folder: Path, stored: dict[str, Any], count: int) -> None:
    """Raise `ValueError` that names the frames which are not those of the sweep: exchanged, edited or never kept."""
    other = []
    for k in range(count):
        for frame_id, told in zip(stored[f"seen_{k}"], stored[f"frames_{k}"], strict=True):
            path = frame_path(folder, int(frame_id))
            if hashlib.sha256(path.read_bytes()).hexdigest() != str(told):
                other.append(path.name)
    if other:
        listed = ", ".join(other[:4]) + (", …" if len(other) > 4 else "")
        raise ValueError(f"{len(other)} of its frames are not those that the sweep took: {listed}")


def _require_arrays(arrays: dict[str, Any]) -> None:
    """Raise `ValueError` where the arrays of a sweep have other shapes than one has, or hold what is no number."""
    n, m = len(arrays["lines"]), len(arrays["seen"])
    shapes = {"flanges": (n, 4, 4), "line_spread": (n, 3), "covariance": (6, 6), "seen": (m,)}
    for name, array in arrays.items():
        if array.shape != shapes.get(name, (n,)) or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            raise ValueError(f"{name} of {n} lines has shape {array.shape}, or holds what is no number")
    for name in ("lines", "seen", "frame_ids"):
        if arrays[name].dtype.kind not in "iu" or (arrays[name] < 0).any():
            raise ValueError(f"{name} must be numbers from 0")
    require_covariance("covariance", arrays["covariance"], range(0))


def _swath(folder: Path, stored: dict[str, Vector], k: int, geometry: ScanGeometry, scan: ScanSection) -> Swath:
    arrays: dict[str, Any] = {name: stored[f"{name}_{k}"] for name in _ARRAYS}
    _require_arrays(arrays)
    lost, residual, shift = stored[f"figures_{k}"]
    if not np.isfinite([lost, residual, shift]).all():
        raise ValueError(f"its figures are {lost}, {residual}, {shift}")
    shape = (geometry.camera.height, geometry.camera.width)
    collector = SweepCollector(geometry, scan, lambda frame, cut: None, lambda fraction, text: None)
    collector.notes = tuple(str(doubt) for doubt in stored.get("doubts", ()) if str(doubt).startswith(REACHES))
    for frame_id in arrays["seen"]:
        image = read_image(frame_path(folder, int(frame_id)), shape)
        collector.see(Frame(image, int(frame_id), scan.exposure, device_time=0.0, host_time=0.0, received=0.0))
    lines = arrays["lines"]
    middle = collector.require_frames("stored sweep", lines)
    return Swath(
        builder=collector.builder, **arrays, lost=int(lost), residual=float(residual), shift=float(shift),
        points=sum(collector.counts[int(line)] for line in lines), middle=middle[0], middle_profile=middle[1],
    )  # fmt: skip
