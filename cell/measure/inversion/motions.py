"""Small motions of a surface in words: translations along axes, rotations about lines, and screws.

Motions that are undetermined together come out of an eigendecomposition mixed at will. They are sorted into pure
translations first and rotations after, along the axes of the surface frame where the mixture allows it.
"""

from __future__ import annotations

import numpy as np

from cell.measure.inversion.closest import Array

PURE = 0.15
"""Share of rotation, in units of the surface's radius, up to which a motion counts as a translation."""


def sorted_out(ways: Array, radius: float) -> list[Array]:
    """Motions (6,) (shift m, turn rad) that span the same as the columns of `ways` (6, k), as plain as they can be."""
    scaled = ways * np.array([1.0] * 3 + [radius] * 3)[:, None]
    basis = np.linalg.svd(scaled, full_matrices=False)[0]
    _, sizes, mixes = np.linalg.svd(basis[3:])
    sizes = np.append(sizes, np.zeros(max(0, len(mixes) - len(sizes))))
    slides = basis @ mixes[sizes <= PURE].T
    turning = basis @ mixes[sizes > PURE].T
    found = [np.append(axis, np.zeros(3)) for axis in _aligned(slides[:3])]
    for axis in _aligned(turning[3:]):
        mix = np.linalg.pinv(turning[3:] / radius) @ axis
        found.append(turning @ mix / np.array([1.0] * 3 + [radius] * 3))
    return found


def name(motion: Array, radius: float) -> str:
    """A motion (shift m, turn rad) in the surface frame in words, the line of a rotation by its point nearest to
    the origin unless it passes there.
    """
    shift, turn = motion[:3], motion[3:]
    angle = float(np.linalg.norm(turn))
    if angle * radius <= 0.2 * float(np.linalg.norm(shift)):
        return f"translation along {_axis(shift)}"
    axis = turn / angle
    along = float(shift @ axis)
    # The line that stays where it is: shift = −turn × point for the point nearest to the origin.
    point = np.cross(axis, shift - along * axis) / angle
    where = ""
    if np.linalg.norm(point) > 0.05 * radius:
        x, y, z = 1e3 * point
        where = f" through ({x:.1f}, {y:.1f}, {z:.1f}) mm"
    pitch = along / angle
    if abs(pitch) > 0.3 * radius:
        where += f" with {1e3 * pitch:+.1f} mm/rad along it"
    return f"rotation about {_axis(axis)}{where}"


def _aligned(directions: Array) -> list[Array]:
    """Unit vectors (3,) that span the columns of `directions` (3, k), along the coordinate axes where they can be."""
    if directions.shape[1] == 0:
        return []
    basis = np.linalg.svd(directions, full_matrices=False)[0]
    count = basis.shape[1]
    if count == 3:
        return list(np.eye(3))
    if count == 1:
        return [basis[:, 0] * np.sign(basis[np.argmax(np.abs(basis[:, 0])), 0])]
    normal = np.cross(basis[:, 0], basis[:, 1])
    nearest = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = nearest - normal * float(normal @ nearest)
    first = first / np.linalg.norm(first)
    second = np.cross(normal, first)
    return [first, second * np.sign(second[np.argmax(np.abs(second))])]


def _axis(vector: Array) -> str:
    direction = vector / np.linalg.norm(vector)
    largest = int(np.argmax(np.abs(direction)))
    if abs(direction[largest]) > 0.97:
        return f"the {'xyz'[largest]} axis of the surface frame"
    x, y, z = direction * np.sign(direction[largest])
    return f"({x:.2f}, {y:.2f}, {z:.2f}) in the surface frame"
