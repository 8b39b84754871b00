"""URScript's commands that only compute: numbers, texts, lists, poses. Source: the maker's script manual."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from sim_backends.models.arm_kinematics import (
    Matrix,
    invert,
    matrix_from_pose,
    pose_from_matrix,
    rotation_matrix,
    rotation_vector,
)
from sim_backends.peers.arm.urscript.environment import Environment
from sim_backends.peers.arm.urscript.values import MOST_ELEMENTS, List, ScriptPose, Struct, shown


def matrix(pose: Any) -> Matrix:
    """A script's pose as (4, 4)."""
    return matrix_from_pose(np.array(pose, float))


def as_pose(base_from_tool: Matrix) -> ScriptPose:
    """(4, 4) as a script's pose."""
    return ScriptPose(pose_from_matrix(base_from_tool).tolist())


def numbers(values: Any) -> List:
    """An array as a script's list."""
    return List(np.asarray(values, float).tolist())


def _norm(value: Any) -> float:
    return math.hypot(*value) if isinstance(value, list) else abs(value)


def _distance(a: Any, b: Any, first: int) -> float:
    return math.dist(a[first : first + 3], b[first : first + 3])


def _turn_between(a: Any, b: Any) -> float:
    return math.hypot(*rotation_vector(matrix(a)[:3, :3].T.dot(matrix(b)[:3, :3])))


def _interpolate(a: Any, b: Any, share: float) -> ScriptPose:
    start, end = matrix(a), matrix(b)
    turn = rotation_vector(start[:3, :3].T.dot(end[:3, :3]))
    between = np.eye(4)
    between[:3, :3] = start[:3, :3].dot(rotation_matrix(turn * share))
    between[:3, 3] = (1 - share) * start[:3, 3] + share * end[:3, 3]
    return as_pose(between)


def _pose_add(a: Any, b: Any) -> ScriptPose:
    sum_ = np.eye(4)
    sum_[:3, :3] = matrix(a)[:3, :3].dot(matrix(b)[:3, :3])
    sum_[:3, 3] = matrix(a)[:3, 3] + matrix(b)[:3, 3]
    return as_pose(sum_)


def _rpy2rotvec(rpy: Any) -> List:
    roll, pitch, yaw = (rotation_matrix(angle * axis) for angle, axis in zip(rpy, np.eye(3), strict=True))
    return numbers(rotation_vector(yaw.dot(pitch).dot(roll)))


def _rotvec2rpy(vector: Any) -> List:
    r = rotation_matrix(np.array(vector, float))
    pitch = math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0]))
    return List([math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])])


def _twist(frame: Any, twist: Any) -> List:
    """A wrench, given in `frame`, in the frame that `frame` is given in."""
    place, force, torque = matrix(frame), np.array(twist[:3], float), np.array(twist[3:], float)
    turned = place[:3, :3].dot(force)
    return numbers([*turned, *(place[:3, :3].dot(torque) + np.cross(place[:3, 3], turned))])


def _to_number(text: str) -> float:
    return float(text) if any(mark in text for mark in ".eE") else int(text)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _integer_to_bits(value: int) -> List:
    return List(bool(value >> bit & 1) for bit in range(32))


def _bits_to_integer(bits: Any) -> int:
    word = sum(bool(bit) << place for place, bit in enumerate(bits[:32]))
    return int(struct.unpack("i", struct.pack("I", word))[0])


def _make_list(length: int, value: Any, capacity: int = 0) -> List:
    if length > MOST_ELEMENTS:
        raise ValueError(f"a list of {length} elements, at most {MOST_ELEMENTS}")
    return List([value] * length)


def _size(values: Any) -> Any:
    """Rows and columns of a matrix, the length of a list."""
    return List([len(values), len(values[0])]) if values and isinstance(values[0], list) else len(values)


def _str_sub(text: str, index: int, length: int = -1) -> str:
    return text[index:] if length < 0 else text[index : index + length]


def commands(environment: Environment) -> dict[str, Callable[..., Any]]:
    """By name; they need nothing of `environment`."""
    return {
        "sin": math.sin, "cos": math.cos, "tan": math.tan, "asin": math.asin, "acos": math.acos, "atan": math.atan,
        "atan2": math.atan2, "sqrt": math.sqrt, "pow": math.pow, "exp": math.exp,
        "log": lambda base, x: math.log(x, base),
        "floor": math.floor, "ceil": math.ceil, "round": round, "norm": _norm, "random": random.random,
        "d2r": math.radians, "r2d": math.degrees, "inv": lambda pose: as_pose(invert(matrix(pose))),
        "pose_inv": lambda pose: as_pose(invert(matrix(pose))),
        "pose_trans": lambda a, b: as_pose(matrix(a).dot(matrix(b))),
        "pose_add": _pose_add,
        "pose_sub": lambda a, b: _pose_add(a, as_pose(invert(matrix(b)))),
        "pose_dist": lambda a, b: _distance(a, b, 0),
        "point_dist": lambda a, b: _distance(a, b, 0),
        "rotation_dist": _turn_between,
        "interpolate_pose": _interpolate,
        "wrench_trans": _twist,
        "rpy2rotvec": _rpy2rotvec, "rotvec2rpy": _rotvec2rpy,
        "str_cat": lambda a, b: shown(a) + shown(b),
        "str_len": len, "str_at": lambda text, index: text[index], "str_empty": lambda text: not text,
        "str_find": lambda text, part, start=0: text.find(part, start),
        "str_sub": _str_sub,
        "to_str": shown, "to_num": _to_number, "is_number": _is_number,
        "get_list_length": len, "length": len, "size": _size,
        "make_list": _make_list,
        "transpose": lambda m: List(List(row) for row in zip(*m, strict=True)),
        "struct": Struct,
        "binary_list_to_integer": _bits_to_integer, "integer_to_binary_list": _integer_to_bits,
    }  # fmt: skip
