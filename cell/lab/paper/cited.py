"""The systems that the paper's introduction cites by a figure, and the head that stands beside each in simulation.

Theirs were measured on hardware, by rules that the paper does not state. Ours are drawn for the same task: baseline,
focal length, sensor and stand-off are chosen, the noise is assumed, and both are data here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cell.lab.paper.rig import Noise, RigSpec

Task = Literal["dent", "arm_base", "form", "stitched"]


@dataclass(frozen=True)
class CitedSystem:
    """One system: `reference` as numbered in the paper, `claim_mm` its headline, `task` how ours is measured.

    Tasks: "dent": single points of a dent's floor against its surroundings within one profile, no pose needed;
    "arm_base": points in the arm's base, at the flange poses as reported; "form": points over the whole depth after one
    rigid motion; "stitched": the same over stations that are joined by their overlaps. `remark` says how the task
    differs from theirs.
    """

    key: str
    name: str
    reference: str
    headline: str
    claim_mm: float
    task: Task
    spec: RigSpec
    remark: str
    claim_points_per_s: float | None = None


# An ordinary arm, less repeatable than the cell's own.
ORDINARY_ARM = Noise(arm=0.1e-3, arm_turn=0.3e-3)
# A precision stage instead of an arm and a stepper rail.
STAGE = Noise(rail=0.002e-3)
LONG_RAIL = Noise(rail=0.05e-3)

SYSTEMS: tuple[CitedSystem, ...] = (
    CitedSystem(
        "hand_held", "hand-held surface inspection", "[7]", "0.30 mm, cracks and depressions", 0.30, "dent", RigSpec(),
        "a dent 2 mm deep; depth within one profile, so that no hand or tracker counts",
    ),
    CitedSystem(
        "arm_mounted", "arm-mounted module", "[12]", "better than 0.5 mm", 0.5, "arm_base",
        RigSpec(noise=ORDINARY_ARM),
        "an arm of 0.1 mm and 0.3 mrad, hand-eye calibrated with it",
    ),
    CitedSystem(
        "tracked", "tracked hand-held scanner", "[13]", "1 mm at 200 mm, 15,000 points/s", 1.0, "arm_base",
        RigSpec(baseline=0.06, meeting=0.2, depths=(0.18, 0.23), board="marked_dots:11x9:4.5mm", noise=ORDINARY_ARM),
        "the arm stands in for their tracker; points/s on one core, from frame to triangulated point",
        claim_points_per_s=15_000.0,
    ),
    CitedSystem(
        "dental", "desktop scanner", "[14]", "40 µm, depth of field 100 mm", 0.04, "form",
        RigSpec(width=2048, height=1088, pixel=3.45e-6, focal=16e-3, baseline=0.1, meeting=0.2, depths=(0.15, 0.25),
                travel=0.1, board="marked_dots:11x9:3.5mm", noise=STAGE),
        "a precision stage instead of their turntable; diffuse surface, no teeth",
    ),
    CitedSystem(
        "body", "body scanner", "[15]", "0.5 mm over 2.2 × 1.2 × 1.2 m, stitched", 0.5, "stitched",
        RigSpec(width=1088, height=2048, pixel=5.5e-6, focal=12e-3, baseline=0.5, meeting=1.3, depths=(0.9, 1.7),
                travel=0.75, board="marked_dots:11x9:40mm", noise=LONG_RAIL),
        "one side only: 2.25 × 1.04 m with 0.2 m of relief, four stations; the expected mean is that of one station, "
        "without the chain",
    ),
)  # fmt: skip


def cited(key: str) -> CitedSystem:
    """The system of that key. Raises ValueError that lists the keys."""
    for system in SYSTEMS:
        if system.key == key:
            return system
    raise ValueError(f"unknown system {key!r}: choose one of {', '.join(s.key for s in SYSTEMS)}")
