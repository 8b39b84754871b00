"""Does the scan head still sit on the flange as it was calibrated? What the fine board in a few pictures says of it.

Between full verifications every job looks at the board once. The arm comes to rest a little elsewhere each time, so one
look is blunt: one that chance seldom brings is repeated, and all looks together decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from cell.measure.calibration.drift.decision import WORST_FIT
from cell.measure.calibration.drift.evidence import PictureMeasurements, Reference, evidence
from cell.measure.calibration.solve.normal import HAND, SHARED, AdjustmentState
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import covariance_root

SUSPICIOUS = 0.1
"""Looks that chance brings more seldom are repeated: one job in ten, of a head that nobody touched."""
CHANCE = 1e-4
"""What chance brings more seldom is a change. Jobs of one calibration share its error: false alarms come together."""


@dataclass(frozen=True, eq=False)
class HeadShift:
    """By how much the scan head has moved on the flange since its calibration, as the fine board shows it.

    `change` (6,) is flange_from_camera's: m along the flange's axes, then rad about them. `covariance` (6, 6) holds
    noise, the arm's rests and the calibration's own. `dots` is the RMS of the dots' whitened residuals, 1 as
    calibrated. `chance` is the probability of so much without any change, `looks` how often the arm came to rest.
    """

    change: Array
    covariance: Array
    dots: float
    chance: float
    looks: int

    @classmethod
    def of(cls, state: AdjustmentState, reference: Reference, looks: Sequence[PictureMeasurements]) -> HeadShift:
        """From pictures of the board, each from a rest of its own, beside the calibrated `state`.

        A head that slipped is shifted or turned, seldom both, so each is held against chance by itself.
        """
        weighed = evidence(state, reference, looks)
        hand = np.eye(SHARED)[:, HAND]
        change, covariance = weighed.change(hand)
        score, information = hand.T @ weighed.score, hand.T @ weighed.information @ hand
        squares = [
            score[part] @ np.linalg.solve(information[part, part], score[part]) for part in (slice(0, 3), slice(3, 6))
        ]
        chance = min(1.0, 2.0 * float(scipy.special.chdtrc(3, max(squares))))
        return cls(change, covariance, weighed.dots, chance, len(looks))

    @property
    def suspicious(self) -> bool:
        """Whether to look again."""
        return self.chance < SUSPICIOUS

    @property
    def changed(self) -> bool:
        """Whether chance does not bring so much."""
        return self.chance < CHANCE

    @property
    def fits(self) -> bool:
        """Whether the pictures show the board as flat and sharp as at the calibration."""
        return self.dots <= WORST_FIT

    @property
    def likely(self) -> Array:
        """The most likely change (27,) of the chain's parameters."""
        made = np.zeros(SHARED)
        made[HAND] = self.change
        return made

    def drawn(self, count: int) -> Array:
        """Changes (count, 27) of the chain's parameters as likely as this one, always the same ones."""
        made = np.zeros((count, SHARED))
        root = covariance_root(self.covariance)
        made[:, HAND] = self.change + np.random.default_rng(0).normal(size=(count, root.shape[1])) @ root.T
        return made
