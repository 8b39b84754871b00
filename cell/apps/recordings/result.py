"""The parts of what `cell calibrate --from` prints as JSON; lengths in mm, angles in rad unless the name says else."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from cell.apps.recordings.frames import RecordedFrame
from cell.measure.calibration.judge.plane_checks import Flatness, PlaneKnown
from cell.measure.calibration.solve.intrinsics import Intrinsics
from cell.measure.calibration.solve.starts import HandEye
from cell.measure.geometry.camera import PARAMETER_NAMES, Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.vision.board.view import BoardSpec

FAR_CAMERA_M = 0.8
CAMERAS = ("intrinsics", "intrinsics_without_distortion", "intrinsics_from_pictures")


def empty_result(spec: BoardSpec | None) -> dict[str, Any]:
    """The keys of every result, nothing known yet."""
    result: dict[str, Any] = {"board": None if spec is None else spec.name, "frames": [], "laser": None, "poses": None}
    result |= {"unread": [], **dict.fromkeys((*CAMERAS, "hand_eye", "light_plane", "flatness", "noise"))}
    return result | {"notes": [], "checks": [], "refused": {}, "refused_values": {}}


def frame_dict(frame: RecordedFrame) -> dict[str, Any]:
    """What became of one frame."""
    return {
        "name": frame.name,
        "used": frame.reason is None,
        "reason": None if frame.reason is None else str(frame.reason),
        "text": frame.text,
        "rms_px": frame.rms_px,
        "points": 0 if frame.view is None else len(frame.view.ids),
        "pose": frame.base_from_flange is not None,
        "pose_from": frame.pose_from or None,
        "stripe": frame.profile is not None,
        "stripe_from": frame.stripe_from or None,
        "stripe_off": frame.stripe_off or None,
        "stripe_text": frame.stripe_text,
        "stripe_left_out": frame.stripe_left_out,
        "order_assumed": frame.view is not None and frame.view.order_assumed,
    }


def intrinsics_dict(found: Intrinsics) -> dict[str, Any]:
    """A camera from pictures alone, px."""
    tried = {name: value for name, value in found.tried.items() if math.isfinite(value)}
    return {
        **camera_dict(found.camera, found.sigma),
        "rms_px": found.point_rms_px,
        "held_out_rms_px": finite(math.sqrt(2) * found.held_out_px),
        "formal_sigma_px": dict(zip(PARAMETER_NAMES[:4], found.formal[:4].tolist(), strict=True)),
        "lens": found.model.name,
        "lens_tried_rms_px": tried,
        "method": "pictures alone",
    }


def camera_dict(camera: CameraModel, sigma: Array) -> dict[str, Any]:
    """A camera's parameters by name, and the σ (4 or more,) of the first four."""
    values = dict(zip(PARAMETER_NAMES, camera.parameters.tolist(), strict=True))
    about = dict(zip(PARAMETER_NAMES[:4], sigma[:4].tolist(), strict=True))
    return {**values, "width": camera.width, "height": camera.height, "sigma_px": about}


def hand_eye_dict(
    setup: str, method: str, pose: pin.SE3, scatter: tuple[float, float], sigma: Array | None = None
) -> dict[str, Any]:
    """A hand-eye pose, its angles as matrix, rotation vector and XYZ Euler angles in rad.

    `scatter` of the board in the base in m and rad; `sigma` (6,) in m and rad.
    """
    r = pose.rotation
    middle = math.asin(max(-1.0, min(1.0, float(r[0, 2]))))
    first, last = math.atan2(-r[1, 2], r[2, 2]), math.atan2(-r[0, 1], r[0, 0])
    if first < 0:
        # Of the two triples for one rotation, that with the first angle in 0 … π.
        first, middle, last = first + math.pi, math.pi - middle, last + math.pi
        middle, last = (math.remainder(angle, 2 * math.pi) for angle in (middle, last))
    found = {
        "method": method,
        "setup": setup,
        "pose": "flange_from_camera" if setup == "eye_in_hand" else "base_from_camera",
        "translation_mm": (1e3 * pose.translation).tolist(),
        "rotation": r.tolist(),
        "rotation_vector_rad": pin.log3(r).tolist(),
        "euler_xyz_rad": [first, middle, last],
        "scatter_mm": 1e3 * scatter[0],
        "scatter_deg": math.degrees(scatter[1]),
    }
    if sigma is not None:
        found |= {"sigma_mm": (1e3 * sigma[:3]).tolist(), "sigma_deg": np.degrees(sigma[3:]).tolist()}
    return found


def closed_form_dict(setup: str, found: HandEye) -> dict[str, Any]:
    """A hand-eye by Park and Martin with the scatter of the board in the base."""
    return hand_eye_dict(setup, "Park-Martin", found.flange_from_camera, (found.scatter_m, found.scatter_rad))


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


def plane_dict(
    method: str, plane: LightPlane, rms: float, noise: float, known: PlaneKnown | None, depths: Array
) -> dict[str, Any]:
    """A light plane n·P = d in the camera frame. `rms`, the stripe's own `noise` and `depths` (n,) in m."""
    return {
        **normal_dict(plane, rms),
        "depth_range_mm": [1e3 * float(np.nanmin(depths)), 1e3 * float(np.nanmax(depths))],
        "sigma_place_mm": None if known is None else 1e3 * known.place,
        "sigma_normal_deg": None if known is None else math.degrees(known.tilt),
        "stripe_noise_mm": 1e3 * noise,
        "method": method,
    }


def normal_dict(plane: LightPlane, rms: float) -> dict[str, Any]:
    """A light plane and the RMS in m of its points."""
    return {"normal": list(plane.normal), "distance_mm": 1e3 * plane.distance, "rms_mm": 1e3 * rms}


def seen_depths(plane: LightPlane, camera: CameraModel, stripes: Sequence[Array]) -> Array:
    """Depths (n,) in m before the camera at which the stripe was seen on the board."""
    depths: Array = plane.intersect(camera.rays(np.concatenate(stripes)))[:, 2]
    return depths


def flatness_dict(flat: Flatness | None, names: Sequence[str]) -> dict[str, Any] | None:
    """How flat the board is in the base, end to end, and frame by frame."""
    return None if flat is None else {
        "rms_mm": 1e3 * flat.rms,
        "p95_mm": 1e3 * flat.p95,
        "points": flat.points,
        "extent_mm": (1e3 * flat.extent).tolist(),
        "per_frame": [{"name": n, "rms_mm": finite(1e3 * v)} for n, v in zip(names, flat.per_frame, strict=True)],
    }  # fmt: skip


def finite(value: float) -> float | None:
    """None for what is not known."""
    return value if math.isfinite(value) else None


def all_finite(values: Mapping[str, float]) -> dict[str, float | None]:
    """The values by name, None for what is not known."""
    return {key: finite(value) for key, value in values.items()}
