"""Named features of a placed part: how far each flat, edge, hole or pin lies from where it belongs, as people measure.

They follow from where the part was seen, which its faces tell as a whole, and from what the points about them say by
themselves; each has a tolerance of its own.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import pinocchio as pin

from cell.config.job import FeatureSection, Job
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.flush import heights_over
from cell.measure.inversion.local_deviation import LocalDeviation, Span, higher_about, seen_middle, seen_rim
from cell.measure.inversion.part_pose import PartPose
from cell.measure.reconstruction.cloud import Cloud
from drivers.errors import Measured
from drivers.interfaces import Vector

LEAST_COUNTED = 0.3
"""Share of a direction that has to count for a feature if what its points say along that is to."""
NOT_SEEN = LocalDeviation()
"""Of a feature about which no points tell: the part as a whole tells where it lies."""


@dataclass(frozen=True, eq=False)
class FeatureSeen:
    """A feature that is `off` its place, m, in the directions in which its kind counts; `bound` is the stated one.

    `belongs` (3,), m, surface frame, is where it should be. Its `own` points put it so far from where the part as a
    whole has it; of that, `own_off` counts. `asked` is whether they tell anything in those directions.
    """

    section: FeatureSection
    off: float
    bound: float
    belongs: Vector
    own: LocalDeviation = NOT_SEEN
    own_off: float = 0.0
    asked: bool = False

    @classmethod
    def of(
        cls, section: FeatureSection, seen: pin.SE3, belongs: pin.SE3, *, motions: Vector, percent: float,
        own: LocalDeviation = NOT_SEEN,
    ) -> Self:  # fmt: skip
        """Of a part that was `seen`, and that `belongs` elsewhere, both surface_from_part.

        `motions` (n, 6), m and rad, surface axes, about the part's origin, are drawn from what is not known of it; the
        bound holds for `percent` of them, and for all that its `own` points leave open.
        """
        at = transform(seen, np.array([section.at]))[0]
        there = transform(belongs, np.array([section.at]))[0]
        errors = motions[:, :3] + np.cross(motions[:, 3:], at - seen.translation)
        counted = counting(section, belongs.rotation)
        off, moved, more, asked = at - there, np.zeros(3), 0.0, False
        for (least, most), way in own.spans:
            if np.linalg.norm(way @ counted) > LEAST_COUNTED:
                # What the part's pose may be off by explains as much of what they say.
                unsure = float(np.percentile(np.abs(errors @ way), percent))
                span, asked = Span(least - unsure, most + unsure), True
                moved, more = moved + span.off * way, more + span.more
        bound = float(np.percentile(np.linalg.norm((off + moved + errors) @ counted, axis=1), percent)) + more
        off_by, own_off = (float(np.linalg.norm(each @ counted)) for each in (off + moved, moved))
        return cls(section, off_by, bound, there, own=own, own_off=own_off, asked=asked)

    @property
    def not_as_drawn(self) -> bool:
        """Whether it is off its place because the part is off its drawing there."""
        return self.own_off > 0.5 * self.off

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
            + f", for the part is off its drawing there by {1e3 * self.own_off:.2f} mm or more"
            * self.not_as_drawn
        )

    def as_dict(self) -> dict[str, object]:
        """For the report."""
        return {
            "name": self.section.name, "kind": self.section.kind, "off_mm": round(1e3 * self.off, 4),
            "bound_mm": round(1e3 * self.bound, 4), "tolerance_mm": round(1e3 * self.section.tolerance, 4),
            "own_higher_mm": _in_mm(self.own.higher),
            "own_farther_mm": _in_mm(self.own.rim and self.own.rim.farther),
            "own_aside_mm": [_in_mm(span) for span, _ in self.own.middle],
        }  # fmt: skip


def _in_mm(span: Span | None) -> list[float] | None:
    return None if span is None else [round(1e3 * end, 4) for end in span]


def by_themselves(job: Job, cloud: Cloud, seen: PartPose, faces: NominalSurface) -> dict[str, LocalDeviation]:
    """What the points of a part in its cloud, arm base, say about each feature that the job names, by name. The part
    has these `faces`, and was `seen` so."""
    if job.part is None or not job.part.feature:
        return {}
    base_from_surface, lies, made = seen.base_from_surface, seen.surface_from_part, {}
    heights = heights_over(cloud, base_from_surface, lies, faces)
    for feature in job.part.feature:
        at, axis = np.array(feature.at), np.array(feature.axis)
        own = LocalDeviation(higher_about(heights, lies.act(at), seen.rocked))
        if feature.kind == "edge":
            own = replace(own, rim=seen_rim(cloud, base_from_surface, lies, faces=faces, at=at, edge=axis))
        elif feature.kind != "flat":
            own = replace(own, middle=seen_middle(cloud, base_from_surface, lies, faces=faces, at=at, axis=axis))
        made[feature.name] = own
    return made


def counting(section: FeatureSection, surface_from_part: Vector) -> Vector:
    """The projection (3, 3), surface axes, onto the directions in which a feature counts: a flat's normal, or all that
    are square to an edge, a hole or a pin. `surface_from_part` is the rotation (3, 3)."""
    axis = surface_from_part @ np.array(section.axis)
    along = np.outer(axis, axis) / float(axis @ axis)
    return along if section.kind == "flat" else np.asarray(np.eye(3) - along)
