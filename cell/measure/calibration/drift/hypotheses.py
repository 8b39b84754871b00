"""What may have changed in a calibrated chain, and how strongly a score speaks for each of these changes.

A hypothesis is a Gaussian change of about `SHIFT` or `TURN` of some parameters of one camera's chain; against it stands
that nothing changed. Scores and information are those of `cell.measure.calibration.drift.evidence`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.measure.calibration.drift.evidence import DriftEvidence
from cell.measure.calibration.solve.blocks import HAND, PLANE, RAIL
from cell.measure.geometry.camera import Array

SHIFT, TURN = 0.2e-3, float(np.deg2rad(0.05))
"""The disturbance that has to be found, m and rad."""
SCAN_DEPTH, TARGET_DEPTH = 0.13, 0.65
"""Where a shift of a focal length counts, m in front of the camera."""


@dataclass(frozen=True)
class Hypothesis:
    """A change of parameters `index` of one camera's chain, of about `size` each; `part` is what a person would fix."""

    part: str
    index: tuple[int, ...]
    size: tuple[float, ...]


def hypotheses(chain: str, focal: float) -> list[Hypothesis]:
    """What may change in the chain of the "scan" or the "target" camera of `focal` length in px."""
    hand = range(HAND.start, HAND.stop)
    mount, lens = f"{chain} camera's mount on the flange", f"{chain} camera's lens"
    depth = SCAN_DEPTH if chain == "scan" else TARGET_DEPTH
    made = [
        Hypothesis(mount, tuple(hand[:3]), (SHIFT,) * 3),
        Hypothesis(mount, tuple(hand[3:]), (TURN,) * 3),
        Hypothesis(lens, (2, 3), (TURN * focal,) * 2),
        Hypothesis(lens, (0, 1), (SHIFT / depth * focal,) * 2),
    ]
    if chain == "scan":
        plane, rail = range(PLANE.start, PLANE.stop), range(RAIL.start, RAIL.stop)
        made += [
            Hypothesis("laser's light plane", tuple(plane), (TURN, TURN, SHIFT)),
            Hypothesis("rail", tuple(rail), (TURN,) * 3),
        ]
    return made


def log_factor(weighed: DriftEvidence, h: Hypothesis, scores: Array) -> Array:
    """Logarithms (n,) of the Bayes factor for a Gaussian change of size `h.size` against none, for scores (n, 27)."""
    gain, offset = quadratic(weighed, h)
    s = scores[:, list(h.index)]
    return np.asarray(0.5 * np.einsum("ni,ij,nj->n", s, gain, s, optimize=True) + offset, dtype=np.float64)


def quadratic(weighed: DriftEvidence, h: Hypothesis) -> tuple[Array, float]:
    """The matrix A (k, k) and the number c for which ½ sᵀA s + c is that logarithm for the score s of `h.index`.

    With the change's covariance P and its information F these are (P⁻¹ + F)⁻¹ and −½ log det(1 + F P).
    """
    index, size = list(h.index), np.array(h.size)
    information = weighed.information[np.ix_(index, index)] * size[:, None] * size
    posterior = np.eye(len(index)) + information
    gain = np.linalg.inv(posterior) * size[:, None] * size
    return np.asarray(0.5 * (gain + gain.T)), -0.5 * float(np.linalg.slogdet(posterior)[1])


def log_mean(factors: Array) -> Array:
    """Logarithm (n,) of the mean of exp over the last axis of (n, k)."""
    most = factors.max(axis=1)
    return np.asarray(most + np.log(np.mean(np.exp(factors - most[:, None]), axis=1)), dtype=np.float64)
