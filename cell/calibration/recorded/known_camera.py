"""A camera that is known already, from a file: JSON of an earlier result, YAML or XML as OpenCV, ROS and ViSP write."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cell.calibration.recorded.texts import decoded, stored_matrix, structured
from cell.geometry.camera import PARAMETER_NAMES, CameraModel
from cell.storage import EditedError, is_intact
from drivers.errors import ConfigError

FORM = "it needs width, height, fx, fy, cx, cy and k1 … k3, or camera_matrix and distortion coefficients"
MATRICES = ("camera_matrix", "K", "mtx", "intrinsic_matrix")
NEXT = "calibrate the camera with OpenCV's plain model (plumb_bob), or leave --camera out: the pictures then tell it"
MODELS = ("distortion_model", "camera_model", "model")
BROWN = (
    "plumb_bob",
    "radtan",
    "brown",
    "brown_conrady",
    "opencv",
    "pinhole",
    "none",
    "perspective",
    "rational_polynomial",
)
"""Names of the lens model with k1, k2, p1, p2 and k3; the rational one is that while its further terms are 0."""
FURTHER_TERMS = ("k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
LEAST_TERMS = 4
FOCAL_RANGE = (0.1, 100.0)
"""Focal lengths over the picture's longer side: from a fisheye's to a long telephoto's."""
OUTSIDE = 0.5
"""How far outside the picture, in its width or height, the principal point may lie."""
LENSES = ("distortion_coefficients", "dist_coeffs", "D", "dist", "distortion")


def read_camera(path: Path) -> CameraModel:
    """The camera of a file. Raises ConfigError that says what is missing."""
    try:
        data = structured(path.suffix.lower(), decoded(path.read_bytes()))
        # A result of `cell calibrate --from`; files of others have no digest.
        if isinstance(data, dict) and not is_intact(data):
            raise EditedError("it was changed after `cell calibrate --from` wrote it; use the result as it was")
    except (OSError, ValueError) as error:
        raise ConfigError(f"--camera {path}: it cannot be read: {error}") from error
    if not isinstance(data, dict):
        raise ConfigError(f"--camera {path}: {FORM}")
    try:
        return _camera(_inner(data))
    except ConfigError as error:
        raise ConfigError(f"--camera {path}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"--camera {path}: {FORM}; {error} is missing or no number") from error


def _inner(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """The map that holds the camera: below `intrinsics`, OpenCV's storage, or ViSP's last model with its size."""
    if any(name in data for name in (*MATRICES, "fx")):
        return data
    if "model" in data and {"image_width", "image_height"} <= set(data):
        models = data["model"] if isinstance(data["model"], list) else [data["model"]]
        return {**_of_visp(models[-1]), "width": data["image_width"], "height": data["image_height"]}
    for value in data.values():
        several = value if isinstance(value, list) else [value]
        if several and isinstance(several[-1], dict) and "data" not in several[-1]:
            found = _inner(several[-1])
            if any(name in found for name in (*MATRICES, "fx")):
                return {**data, **found}
    return data


def _of_visp(model: Mapping[str, Any]) -> dict[str, Any]:
    """ViSP's names as those used here: its kud is k1, its kdu an inverse that is not needed."""
    if "Kannala" in str(model.get("type")):
        raise ConfigError(f"the model's type is {model['type']}, read can be perspectiveProjWithDistortion; {NEXT}")
    lens = {"k1": model.get("kud", 0.0)}
    return {"fx": model["px"], "fy": model["py"], "cx": model["u0"], "cy": model["v0"], **lens}


def _camera(data: Mapping[str, Any]) -> CameraModel:
    width, height = (int(_first(data, names)) for names in (("width", "image_width"), ("height", "image_height")))
    camera = CameraModel(width, height, 1.0, 1.0, 0.0, 0.0)
    _check_model(data)
    if "fx" in data:
        values = [float(data.get(name, 0.0)) if name[0] in "kp" else float(data[name]) for name in PARAMETER_NAMES]
        further = {name: float(data[name]) for name in FURTHER_TERMS if name in data}
    else:
        matrix = _numbers(_first(data, MATRICES)).reshape(3, 3)
        if matrix[0, 1] or matrix[1, 0] or not np.array_equal(matrix[2], (0, 0, 1)):
            raise ConfigError(
                f"{_key(data, MATRICES)} is {matrix.tolist()}, it must be fx 0 cx, 0 fy cy, 0 0 1; {NEXT}"
            )
        lens = _numbers(_first(data, LENSES))
        if len(lens) < LEAST_TERMS and lens.any():
            raise ConfigError(
                f"{_key(data, LENSES)} has {len(lens)} numbers, k1, k2, p1, p2 and perhaps k3 are needed; {NEXT}"
            )
        values = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *lens[:5], *np.zeros(max(0, 5 - len(lens)))]
        further = {f"{_key(data, LENSES)}[{k + 5}]": float(value) for k, value in enumerate(lens[5:])}
    for name, value in further.items():
        if value != 0.0:
            raise ConfigError(f"{name} is {value:g}: the lens here has k1, k2, p1, p2 and k3 only; {NEXT}")
    return _checked(camera.with_parameters(values))


def _check_model(data: Mapping[str, Any]) -> None:
    """Refuse lenses of another model, whose numbers would be read as Brown's. Raises ConfigError."""
    for name in MODELS:
        if name in data and str(data[name]).lower().replace("-", "_") not in BROWN:
            raise ConfigError(f"{name} is {data[name]}, read can be {' and '.join(BROWN[:2])}; {NEXT}")


def _checked(camera: CameraModel) -> CameraModel:
    """The camera, when it can be one. Raises ConfigError that names the value."""
    for name, value in zip(PARAMETER_NAMES, camera.parameters, strict=True):
        if not np.isfinite(value):
            raise ConfigError(f"{name} is {value}, it must be a finite number; {NEXT}")
    if camera.width <= 0 or camera.height <= 0:
        raise ConfigError(f"the picture is {camera.width}×{camera.height} px, both must be positive; {NEXT}")
    longer = max(camera.width, camera.height)
    low, high = FOCAL_RANGE
    for name, focal in (("fx", camera.fx), ("fy", camera.fy)):
        if not low * longer <= focal <= high * longer:
            raise ConfigError(f"{name} is {focal:g} px, allowed are {low * longer:g} to {high * longer:g} px; {NEXT}")
    for name, at, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if not -OUTSIDE * size <= at <= (1 + OUTSIDE) * size:
            raise ConfigError(
                f"{name} is {at:g} px, allowed are {-OUTSIDE * size:g} to {(1 + OUTSIDE) * size:g} px in a picture of "
                f"{size} px; {NEXT}"
            )
    return camera


def _key(data: Mapping[str, Any], names: tuple[str, ...]) -> str:
    return next(name for name in names if name in data)


def _first(data: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    for name in names:
        if name in data:
            return data[name]
    raise KeyError(names[0])


def _numbers(value: Any) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    matrix = stored_matrix(value) if isinstance(value, dict) else value
    return np.ravel(np.asarray(value["data"] if matrix is None else matrix, dtype=np.float64))
