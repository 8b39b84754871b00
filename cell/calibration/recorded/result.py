"""The parts of what `cell calibrate --from` prints as JSON; lengths in mm, angles in rad unless the name says else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from cell.calibration.recorded.folder import RecordedFrame
from cell.calibration.recorded.stripes import Channel
from cell.calibration.solve.flatness import Flatness
from cell.calibration.solve.hand_eye import HandEye
from cell.calibration.solve.intrinsics import Intrinsics
from cell.geometry.camera import PARAMETER_NAMES, Array, CameraModel
from cell.geometry.light_plane import LightPlane
from cell.vision.board.spec import BoardSpec

FAR_CAMERA_M = 0.8


def empty_result(spec: BoardSpec | None) -> dict[str, Any]:
    """The keys of every result, nothing known yet."""
    keys = (
        "intrinsics",
        "intrinsics_without_distortion",
        "intrinsics_from_pictures",
        "hand_eye",
        "light_plane",
        "flatness",
        "noise",
    )
    return {
        "board": None if spec is None else spec.name,
        "frames": [],
        "laser": None,
        "poses": None,
        "unread": [],
        "frames_rms": {},
        **dict.fromkeys(keys),
        "notes": [],
        "checks": [],
        "refused": {},
        "refused_values": {},
    }


def frame_dict(frame: RecordedFrame, rms: dict[str, float]) -> dict[str, Any]:
    """What became of one frame; `rms` in px by file name."""
    return {
        "name": frame.name,
        "used": frame.reason is None,
        "reason": None if frame.reason is None else str(frame.reason),
        "text": frame.text,
        "rms_px": rms.get(frame.name),
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


def channel_dict(channel: Channel) -> dict[str, Any]:
    """In what the laser was read, and what spoke for it."""
    return {
        "asked": str(channel.asked or "none"),
        "channel": str(channel.chosen or "none"),
        "looked": channel.looked,
        "votes": channel.votes,
    }


def intrinsics_dict(found: Intrinsics) -> dict[str, Any]:
    """A camera from pictures alone, px."""
    return {
        **camera_dict(found.camera),
        "rms_px": found.point_rms_px,
        "held_out_rms_px": math.sqrt(2) * found.held_out_px if math.isfinite(found.held_out_px) else None,
        "sigma_px": dict(zip(PARAMETER_NAMES[:4], found.sigma[:4].tolist(), strict=True)),
        "formal_sigma_px": dict(zip(PARAMETER_NAMES[:4], found.formal[:4].tolist(), strict=True)),
        "lens": found.model.name,
        "lens_tried_rms_px": {name: v for name, v in found.tried.items() if math.isfinite(v)},
        "method": "pictures alone",
    }


def camera_dict(camera: CameraModel) -> dict[str, Any]:
    """A camera's parameters by name."""
    values = dict(zip(PARAMETER_NAMES, camera.parameters.tolist(), strict=True))
    return {**values, "width": camera.width, "height": camera.height}


def closed_form_dict(setup: str, found: HandEye) -> dict[str, Any]:
    """A hand-eye by Park and Martin with the scatter of the board in the base."""
    return {
        "method": "Park-Martin",
        **hand_eye_dict(setup, found.flange_from_camera),
        "scatter_mm": 1e3 * found.scatter_m,
        "scatter_deg": math.degrees(found.scatter_rad),
    }


def hand_eye_dict(setup: str, pose: pin.SE3) -> dict[str, Any]:
    """A hand-eye pose, its angles as rotation matrix, rotation vector and XYZ Euler angles in rad."""
    r = pose.rotation
    middle = math.asin(max(-1.0, min(1.0, float(r[0, 2]))))
    first, last = math.atan2(-r[1, 2], r[2, 2]), math.atan2(-r[0, 1], r[0, 0])
    if first < 0:
        # Of the two triples for one rotation, that with the first angle in 0 … π.
        first, middle, last = first + math.pi, math.pi - middle, last + math.pi
        middle, last = (math.remainder(angle, 2 * math.pi) for angle in (middle, last))
    return {
        "setup": setup,
        "pose": "flange_from_camera" if setup == "eye_in_hand" else "base_from_camera",
        "translation_mm": (1e3 * pose.translation).tolist(),
        "rotation": r.tolist(),
        "rotation_vector_rad": pin.log3(r).tolist(),
        "euler_xyz_rad": [first, middle, last],
    }


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


def plane_dict(plane: LightPlane) -> dict[str, Any]:
    """A light plane n·P = d in the camera frame."""
    return {"normal": list(plane.normal), "distance_mm": 1e3 * plane.distance}


def seen_depths(plane: LightPlane, camera: CameraModel, stripes: Sequence[Array]) -> list[float]:
    """Least and largest distance in mm before the camera at which the stripe was seen on the board."""
    depths = plane.intersect(camera.rays(np.concatenate(stripes)))[:, 2]
    return [1e3 * float(np.nanmin(depths)), 1e3 * float(np.nanmax(depths))]


def flatness_dict(flat: Flatness, names: Sequence[str]) -> dict[str, Any]:
    """How flat the board is in the base, end to end, and frame by frame."""
    return {
        "rms_mm": 1e3 * flat.rms,
        "p95_mm": 1e3 * flat.p95,
        "points": flat.points,
        "extent_mm": (1e3 * flat.extent).tolist(),
        "per_frame": [{"name": n, "rms_mm": finite_mm(v)} for n, v in zip(names, flat.per_frame, strict=True)],
    }


def finite_mm(metres: float) -> float | None:
    """In mm, None for what is not known."""
    return 1e3 * metres if math.isfinite(metres) else None
