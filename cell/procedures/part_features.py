"""Named features of a placed part: how far each flat, edge, hole or pin lies from where it belongs, as people measure.

They follow from where the part was seen, which its faces tell as a whole; each has a tolerance of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.config.job import FeatureSection
from cell.measure.geometry.poses import transform
from drivers.errors import Measured
from drivers.interfaces import Vector


@dataclass(frozen=True, eq=False)
class FeatureSeen:
    """A feature that is `off` its place, m, in the directions in which its kind counts; `bound` is the stated one.

    `belongs` (3,), m, surface frame, is where it should be.
    """

    section: FeatureSection
    off: float
    bound: float
    belongs: Vector

    @classmethod
    def of(
        cls, section: FeatureSection, seen: pin.SE3, belongs: pin.SE3, *, motions: Vector, percent: float
    ) -> FeatureSeen:
        """Of a part that was `seen`, and that `belongs` elsewhere, both surface_from_part.

        `motions` (n, 6), m and rad, surface axes, about the part's origin, are drawn from what is not known of it; the
        bound holds for `percent` of them.
        """
        at = transform(seen, np.array([section.at]))[0]
        there = transform(belongs, np.array([section.at]))[0]
        off = at - there
        errors = motions[:, :3] + np.cross(motions[:, 3:], at - seen.translation)
        counted = counting(section, belongs.rotation)
        bound = float(np.percentile(np.linalg.norm((off + errors) @ counted, axis=1), percent))
        return cls(section, float(np.linalg.norm(off @ counted)), bound, there)

    @property
    def measured(self) -> Measured:
        """The bound beside the feature's tolerance."""
        return Measured(
            f"{self.section.kind} {self.section.name}, stated bound", 1e3 * self.bound, "mm",
            most=1e3 * self.section.tolerance,
        )  # fmt: skip

    @property
    def words(self) -> str:
        """For people."""
        return (
            f"the {self.section.kind} {self.section.name} is {1e3 * self.off:.2f} mm off, and may be "
            f"{1e3 * self.bound:.2f} mm (allowed: at most {1e3 * self.section.tolerance:g} mm)"
        )

    def as_dict(self) -> dict[str, object]:
        """For the report."""
        return {
            "name": self.section.name, "kind": self.section.kind, "off_mm": round(1e3 * self.off, 4),
            "bound_mm": round(1e3 * self.bound, 4), "tolerance_mm": round(1e3 * self.section.tolerance, 4),
        }  # fmt: skip


def counting(section: FeatureSection, surface_from_part: Vector) -> Vector:
    """The projection (3, 3), surface axes, onto the directions in which a feature counts: a flat's normal, or all that
    are square to an edge, a hole or a pin. `surface_from_part` is the rotation (3, 3)."""
    axis = surface_from_part @ np.array(section.axis)
    along = np.outer(axis, axis) / float(axis @ axis)
    return along if section.kind == "flat" else np.asarray(np.eye(3) - along)
