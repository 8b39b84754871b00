"""A camera that is known already, from a file: JSON of an earlier result, YAML or XML as OpenCV, ROS and ViSP write."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cell.apps.recordings.texts import decoded, stored_matrix, structured
from cell.base.storage import EditedError, is_intact
from cell.measure.geometry.camera import PARAMETER_NAMES, Array, CameraModel
from drivers.errors import ConfigError

FORM = "it needs width, height, fx, fy, cx, cy and k1 … k3, or camera_matrix and distortion coefficients"
MATRICES = ("camera_matrix", "K", "mtx", "intrinsic_matrix")
LENSES = ("distortion_coefficients", "dist_coeffs", "D", "dist", "distortion", "coeffs")
NEXT = "calibrate the camera with OpenCV's plain model (plumb_bob), or leave --camera out: the pictures then tell it"
MODELS = ("distortion_model", "camera_model", "model")
BROWN = re.compile("plumb_bob|radtan|brown(_conrady)?|opencv|pinhole|none|perspective|rational_polynomial")
"""Names of the lens model with k1, k2, p1, p2 and k3; the rational one is that while its further terms are 0."""
FURTHER_TERMS = ("k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
LEAST_TERMS = 4
FOCAL_RANGE = (0.1, 100.0)
"""Focal lengths over the picture's longer side: from a fisheye's to a long telephoto's."""
OUTSIDE = 0.5
"""How far outside the picture, in its width or height, the principal point may lie."""


def read_camera(path: Path) -> CameraModel:
    """The camera of a file. Raises ConfigError that says what is missing."""
    try:
        data = structured(path.suffix.lower(), decoded(path.read_bytes()))
        # A result of `cell calibrate --from`; files of others have no digest.
        if isinstance(data, dict) and not is_intact(data):
            raise EditedError("it was changed after `cell calibrate --from` wrote it; use the result as it was")
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"--camera {path}: it cannot be read: {error}") from error
    try:
        if not isinstance(data, dict):
            raise ConfigError(FORM)
        return _camera(_inner(data))
    except ConfigError as error:
        raise ConfigError(f"--camera {path}: {error}") from error
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ConfigError(f"--camera {path}: {FORM}; {error} is missing or no number") from error


def _inner(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """The map that holds the camera: below `intrinsics`, OpenCV's storage, or ViSP's last model with its size."""
    if any(name in data for name in (*MATRICES, "fx")):
        return data
    if {"model", "image_width", "image_height"} <= set(data):
        model = data["model"][-1] if isinstance(data["model"], list) else data["model"]
        if "Kannala" in str(model.get("type")):
            kind = f"the model's type is {model['type']}"
            raise ConfigError(f"{kind}, read can be perspectiveProjWithDistortion; {NEXT}")
        # ViSP's kud is k1, its kdu an inverse that is not needed.
        names = {"fx": "px", "fy": "py", "cx": "u0", "cy": "v0"}
        found = {name: model[its] for name, its in names.items()} | {"k1": model.get("kud", 0.0)}
        return found | {"width": data["image_width"], "height": data["image_height"]}
    for value in data.values():
        last = value[-1] if isinstance(value, list) and value else value
        if isinstance(last, dict) and "data" not in last:
            inner = _inner(last)
            if any(name in inner for name in (*MATRICES, "fx")):
                return {**data, **inner}
    return data


def _camera(data: Mapping[str, Any]) -> CameraModel:
    """The camera of a map. Raises ConfigError for another lens, whose numbers would be read as Brown's."""
    width, height = (int(data[_key(data, names)]) for names in (("width", "image_width"), ("height", "image_height")))
    for name in MODELS:
        if name in data and not BROWN.fullmatch(str(data[name]).lower().replace("-", "_")):
            raise ConfigError(f"{name} is {data[name]}, read can be plumb_bob and radtan; {NEXT}")
    values = [float(data[name]) for name in PARAMETER_NAMES[:4]] if "fx" in data else _of_matrix(data)
    if "fx" in data and ("k1" in data or not any(name in data for name in LENSES)):
        values += [float(data.get(name, 0.0)) for name in PARAMETER_NAMES[4:]]
        further = {name: float(data[name]) for name in FURTHER_TERMS if name in data}
    else:
        lens, further = _lens_of_list(data)
        values += lens
    for name, value in further.items():
        if value != 0.0:
            raise ConfigError(f"{name} is {value:g}: the lens here has k1, k2, p1, p2 and k3 only; {NEXT}")
    camera = CameraModel(width, height, 1.0, fy=1.0, cx=0.0, cy=0.0).with_parameters(values)
    _require_possible(camera)
    return camera


def _of_matrix(data: Mapping[str, object]) -> list[float]:
    """fx, fy, cx and cy of a camera matrix."""
    of = _key(data, MATRICES)
    matrix = _numbers(data[of]).reshape(3, 3)
    if matrix[0, 1] or matrix[1, 0] or not np.array_equal(matrix[2], (0, 0, 1)):
        raise ConfigError(f"{of} is {matrix.tolist()}, it must be fx 0 cx, 0 fy cy, 0 0 1; {NEXT}")
    return [float(v) for v in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])]


def _lens_of_list(data: Mapping[str, Any]) -> tuple[list[float], dict[str, float]]:
    """k1, k2, p1, p2 and k3 of a lens's coefficients, and by name the coefficients that follow these."""
    of = _key(data, LENSES)
    lens = _numbers(data[of]).tolist()
    if len(lens) < LEAST_TERMS and any(lens):
        raise ConfigError(f"{of} has {len(lens)} numbers, k1, k2, p1, p2 and perhaps k3 are needed; {NEXT}")
    return [*lens[:5], *[0.0] * (5 - len(lens))], {f"{of}[{k + 5}]": value for k, value in enumerate(lens[5:])}


def _require_possible(camera: CameraModel) -> None:
    """ConfigError for a camera with a parameter that is not finite, or out of every camera's range."""
    size, longer = f"{camera.width}×{camera.height} px", max(camera.width, camera.height)
    if camera.width <= 0 or camera.height <= 0:
        raise ConfigError(f"the picture is {size}, both must be positive; {NEXT}")
    focal = FOCAL_RANGE[0] * longer, FOCAL_RANGE[1] * longer
    allowed = {"fx": focal, "fy": focal}
    allowed |= {n: (-OUTSIDE * px, (1 + OUTSIDE) * px) for n, px in (("cx", camera.width), ("cy", camera.height))}
    for name, value in zip(PARAMETER_NAMES, camera.parameters, strict=True):
        if not np.isfinite(value):
            raise ConfigError(f"{name} is {value}, it must be a finite number; {NEXT}")
        low, high = allowed.get(name, (-math.inf, math.inf))
        if not low <= value <= high:
            raise ConfigError(
                f"{name} is {value:g} px, allowed are {low:g} to {high:g} px in a picture of {size}; {NEXT}"
            )


def _key(data: Mapping[str, Any], names: tuple[str, ...]) -> str:
    return next((name for name in names if name in data), names[0])


def _numbers(value: Any) -> Array:
    matrix = stored_matrix(value) if isinstance(value, dict) else value
    found: Array = np.ravel(np.asarray(value["data"] if matrix is None else matrix, dtype=np.float64))
    return found
