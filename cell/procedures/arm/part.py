"""What has become of the part in the claw: held, released, or not known."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import pinocchio as pin


class PartState(Enum):
    """Where the part is, as far as the claw's commands and its feedback tell."""

    HELD = "held"
    UNKNOWN = "unknown"
    RELEASED = "released"


@dataclass(eq=False)
class PartProgress:
    """What has become of the part, kept beside the step: a run may be ended by others while the part is on its way.

    `where` is base_from_part at the release; `left` tells whether the arm has gone from there and folded.
    """

    state: PartState = PartState.HELD
    where: pin.SE3 | None = None
    left: bool = False

    def told(self, reason: str) -> str:
        """A run's reason, not to be read without what has become of the part."""
        if self.state is PartState.HELD or self.where is None:
            return reason
        x, y, z = 1e3 * self.where.translation
        at = f"at ({x:.1f}, {y:.1f}, {z:.1f}) mm in the arm base"
        if self.state is PartState.RELEASED:
            failed = "" if self.left else ", only the retreat failed"
            return f"the part is already down {at} and is not to be placed again{failed}: {reason}"
        return f"the claw was told to release the part {at}, look whether it did: {reason}"
