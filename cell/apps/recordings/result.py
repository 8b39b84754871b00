"""What `cell calibrate --from` found, with one serialiser; lengths in mm, angles in deg unless the name says else."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from cell.base.storage import strict
from cell.measure.calibration.judge.checks import QualityCheck, refused_parts
from cell.measure.calibration.judge.plane_checks import Flatness
from cell.measure.calibration.solve.starts import HandEye
from cell.measure.geometry.camera import PARAMETER_NAMES, Array, CameraModel

FAR_CAMERA_M = 0.8
Figures = dict[str, object]


@dataclass
class RecordedResult:
    """All that was found in a folder; None for what it does not tell, or what is `refused`, by part, with the reason.

    - `frames`: of each `name`, `used`, `reason`, `text`, `rms_px`, `points`, `pose`, `pose_from`, `stripe` and more;
    - `laser`: what was `asked`, and in which `channel` it was read, by the `votes` of the pictures;
    - `poses`: `source`, `reading`, `unit`, `setup`, `matched_by`, `evidence`;
    - `unread`: `name` and `reason` of each file that was not understood;
    - `notes`: what could not be had, and why; `refused_values`: what was found of a refused part.
    """

    board: str | None = None
    frames: list[Figures] = field(default_factory=list)
    laser: Figures | None = None
    poses: Figures | None = None
    unread: list[dict[str, str]] = field(default_factory=list)
    intrinsics: Figures | None = None
    intrinsics_without_distortion: Figures | None = None
    intrinsics_from_pictures: Figures | None = None
    hand_eye: Figures | None = None
    light_plane: Figures | None = None
    flatness: Figures | None = None
    noise: Figures | None = None
    notes: list[str] = field(default_factory=list)
    checks: list[QualityCheck] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)
    refused_values: Figures = field(default_factory=dict)

    def as_dict(self) -> Figures:
        """For the JSON: arrays as lists, None for numbers that are not finite."""
        told = {each.name: strict(getattr(self, each.name)) for each in fields(self)}
        return told | {"checks": [check.as_dict() for check in self.checks]}

    def apply(self, checks: Sequence[QualityCheck]) -> None:
        """Keep the checks, say what is doubtful, and take out what is refused. A light plane and a hand-eye rest on the
        camera: they are refused with it."""
        self.checks = list(checks)
        self.notes += [f"doubtful: {check.text}" for check in checks if check.verdict == "doubt"]
        failed = {part: "; ".join(check.text for check in found) for part, found in refused_parts(checks).items()}
        gone = list(failed)
        if "intrinsics" in failed:
            for part in ("hand_eye", "light_plane"):
                if getattr(self, part) is not None:
                    rests = f"{part.replace('_', '-')}: it rests on the camera, which is refused"
                    failed.setdefault(part, rests)
            gone = ["intrinsics_without_distortion", "intrinsics_from_pictures", *failed]
        self.refused |= failed
        for part in gone:
            self.refused_values[part] = getattr(self, part)
            setattr(self, part, None)
        if "hand_eye" in failed or "light_plane" in failed:
            self.flatness = None


def camera_figures(camera: CameraModel, sigma: Array, rms_px: float, held_out: float, lens: str) -> Figures:
    """A camera in px with its σ (4 or more,); `rms_px` per point, as OpenCV has it, `held_out` that of left-out views
    per component."""
    values = dict(zip(PARAMETER_NAMES, camera.parameters.tolist(), strict=True))
    about = dict(zip(PARAMETER_NAMES[:4], sigma[:4].tolist(), strict=True))
    held_out_px = math.sqrt(2) * held_out
    size = {"width": camera.width, "height": camera.height}
    return {**values, **size, "sigma_px": about, "rms_px": rms_px, "held_out_rms_px": held_out_px, "lens": lens}


def hand_eye_figures(
    setup: str, method: str, pose: pin.SE3, scatter: tuple[float, float], sigma: Array | None = None
) -> Figures:
    """A hand-eye pose, its angles as matrix, rotation vector and XYZ Euler angles in rad. `scatter` of the board in the
    base in m and rad; `sigma` (6,) in m and rad."""
    first, middle, last = Rotation.from_matrix(pose.rotation).as_euler("XYZ").tolist()
    if first < 0:
        # Of the two triples for one rotation, that with the first angle in 0 … π.
        first, middle, last = first + math.pi, math.pi - middle, last + math.pi
        middle, last = (math.remainder(angle, 2 * math.pi) for angle in (middle, last))
    found: Figures = {
        "method": method, "setup": setup,
        "pose": "flange_from_camera" if setup == "eye_in_hand" else "base_from_camera",
        "translation_mm": 1e3 * pose.translation, "rotation": pose.rotation,
        "rotation_vector_rad": pin.log3(pose.rotation),
        "euler_xyz_rad": [first, middle, last], "scatter_mm": 1e3 * scatter[0],
        "scatter_deg": math.degrees(scatter[1]),
    }  # fmt: skip
    if sigma is not None:
        found |= {"sigma_mm": 1e3 * sigma[:3], "sigma_deg": np.degrees(sigma[3:])}
    return found


def closed_form_figures(setup: str, found: HandEye) -> Figures:
    """A hand-eye by Park and Martin with the scatter of the board in the base."""
    return hand_eye_figures(setup, "Park-Martin", found.flange_from_camera, (found.scatter_m, found.scatter_rad))


def flatness_figures(flat: Flatness | None, names: Sequence[str]) -> Figures | None:
    """How flat the board is in the base, end to end, and frame by frame."""
    if flat is None:
        return None
    per_frame = [{"name": name, "rms_mm": 1e3 * rms} for name, rms in zip(names, flat.per_frame, strict=True)]
    whole = {"rms_mm": 1e3 * flat.rms, "p95_mm": 1e3 * flat.p95, "points": flat.points}
    return {**whole, "extent_mm": 1e3 * flat.extent, "per_frame": per_frame}


def setup_note(setup: str, pose: pin.SE3) -> list[str]:
    """What the poses cannot tell: whether they are base_from_flange, or the base in the flange."""
    if setup == "eye_to_hand":
        return [
            "by the poses the camera stands still and the board moves with the flange; if the camera rides on the "
            "flange, the poses are those of the base in the flange (inverse)"
        ]
    far = float(np.linalg.norm(pose.translation))
    if far < FAR_CAMERA_M:
        return []
    return [
        f"doubt: the camera would ride on the flange {far:.2f} m away from it (usual: below {FAR_CAMERA_M:.1f} m); "
        "does it stand still, and the board move with the flange? Then the poses are those of the base in the flange: "
        "invert them"
    ]
