"""A camera that is known already, from a file: JSON of an earlier result, or YAML as OpenCV and ROS write it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cell.calibration.recorded.yaml_subset import read_yaml
from cell.geometry.camera import PARAMETER_NAMES, CameraModel
from drivers.errors import ConfigError

FORM = "it needs width, height, fx, fy, cx, cy and k1 … k3, or camera_matrix and distortion coefficients"
MATRICES = ("camera_matrix", "K", "mtx", "intrinsic_matrix")
LENSES = ("distortion_coefficients", "dist_coeffs", "D", "dist", "distortion")


def read_camera(path: Path) -> CameraModel:
    """The camera of a file. Raises ConfigError that says what is missing."""
    try:
        text = path.read_text(encoding="utf-8")
        data = json.loads(text) if path.suffix.lower() == ".json" else read_yaml(text)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--camera {path}: it cannot be read: {error}") from error
    if isinstance(data, dict) and isinstance(data.get("intrinsics"), dict):
        data = data["intrinsics"]
    if not isinstance(data, dict):
        raise ConfigError(f"--camera {path}: {FORM}")
    try:
        return _camera(data)
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"--camera {path}: {FORM}; {error} is missing or no number") from error


def _camera(data: Mapping[str, Any]) -> CameraModel:
    width, height = (int(_first(data, names)) for names in (("width", "image_width"), ("height", "image_height")))
    camera = CameraModel(width, height, 1.0, 1.0, 0.0, 0.0)
    if "fx" in data:
        values = [float(data.get(name, 0.0)) if name[0] in "kp" else float(data[name]) for name in PARAMETER_NAMES]
        return camera.with_parameters(values)
    matrix = _numbers(_first(data, MATRICES)).reshape(3, 3)
    lens = np.zeros(5)
    found = _numbers(_first(data, LENSES))[:5]
    lens[: len(found)] = found
    return camera.with_parameters([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *lens])


def _first(data: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    for name in names:
        if name in data:
            return data[name]
    raise KeyError(names[0])


def _numbers(value: Any) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.ravel(np.asarray(value["data"] if isinstance(value, dict) else value, dtype=np.float64))
