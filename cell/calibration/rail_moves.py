"""The rail's direction and scale from photographs between which only the rail moved.

Views of a calibration each carry the arm's repeatability of their own, and so does the rail in them. Where the arm
rests while the rail moves, it drops out: such photographs sharpen a joint adjustment afterwards, as one linear step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from cell.calibration.adjustment import Adjusted
from cell.calibration.blocks import SHARED, State
from cell.calibration.evidence import Look, dots_of, evidence
from cell.calibration.observations import ScanObservation
from cell.calibration.reference import Reference

# Far more than any arm's repeatability: where the flange is at all, the joint adjustment knows already.
ANYWHERE_M, ANYWHERE_RAD = 5e-3, 1e-2


def with_rail_moves(adjusted: Adjusted, observations: Sequence[ScanObservation]) -> tuple[State, Reference]:
    """The adjusted state and its reference after the observations that are marked `same_rest`.

    With score s and information F of their evidence, and C the covariance before, the estimate moves by C s and the
    covariance becomes C − C F C (the Kalman step of a linear model). Without such observations nothing changes.
    """
    reference = Reference.of(adjusted)
    looks: list[Look] = []
    rest = 0
    for before, observation in pairwise(observations):
        if not observation.same_rest or observation.view is None:
            continue
        if not before.same_rest:
            rest += 1
            if before.view is not None:
                looks.append(Look(dots_of(before), rest - 1, len(looks)))
        looks.append(Look(dots_of(observation), max(0, rest - 1), len(looks)))
    state = replace(adjusted.state, flanges=[], rails=np.zeros(0))
    if not looks:
        return state, reference
    free = replace(reference, arm_translation=ANYWHERE_M, arm_rotation=ANYWHERE_RAD)
    weighed = evidence(state, free, looks)
    before_cov = reference.covariance
    covariance = before_cov - before_cov @ weighed.information @ before_cov
    moved = state.moved((before_cov @ weighed.score)[:SHARED])
    return moved, replace(
        reference, base_from_board=moved.base_from_board, covariance=0.5 * (covariance + covariance.T)
    )
