"""What a calibration leaves behind so that it can be verified later: where its board was, and how sure all of it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pinocchio as pin

from cell.measure.calibration.solve.adjustment import Adjusted
from cell.measure.calibration.solve.blocks import SHARED
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import from_matrix


@dataclass(frozen=True, eq=False)
class Reference:
    """The board in the arm's base, and the covariance (27, 27) of everything that the calibration estimated.

    The covariance is in the order of `cell.measure.calibration.solve.blocks` (camera, light plane, rail, hand-eye,
    board), zero where nothing was estimated, and allows for the scatter that was found. `arm_translation` (m),
    `arm_rotation` (rad) and `rail` (m) are the standard deviations per axis of a flange pose and of a rail reading: as
    configured, or as found where that was more. `dots_scale` and `stripe_scale` multiply the stated σ of dots and
    stripe.
    """

    base_from_board: pin.SE3
    covariance: Array
    arm_translation: float
    arm_rotation: float
    rail: float
    dots_scale: float
    stripe_scale: float

    @classmethod
    def of(cls, adjusted: Adjusted) -> Self:
        """Of a joint adjustment."""
        excess = {name: max(1.0, adjusted.excess.get(name, 1.0)) for name in ("shift", "turn", "rail")}
        priors = adjusted.priors
        return cls(
            adjusted.state.base_from_board,
            adjusted.reliable_covariance,
            priors.arm_translation * excess["shift"],
            arm_rotation=priors.arm_rotation * excess["turn"],
            rail=priors.rail * excess["rail"],
            dots_scale=priors.dots_scale,
            stripe_scale=priors.stripe_scale,
        )

    def as_dict(self) -> dict[str, Any]:
        """For storage."""
        return {
            "base_from_board": self.base_from_board.homogeneous.tolist(),
            "covariance": self.covariance.tolist(),
            "sigma": {"arm_translation": self.arm_translation, "arm_rotation": self.arm_rotation, "rail": self.rail},
            "scale": {"dots": self.dots_scale, "stripe": self.stripe_scale},
        }

    @classmethod
    def read(cls, data: dict[str, Any] | None) -> Self | None:
        """From storage, None for None; KeyError, TypeError or ValueError when it is not one."""
        if data is None:
            return None
        sigma, scale = data["sigma"], data["scale"]
        return cls(
            from_matrix(data["base_from_board"]),
            np.array(data["covariance"], dtype=np.float64).reshape(SHARED, SHARED),
            float(sigma["arm_translation"]),
            arm_rotation=float(sigma["arm_rotation"]),
            rail=float(sigma["rail"]),
            dots_scale=float(scale["dots"]),
            stripe_scale=float(scale["stripe"]),
        )
