"""A guarded motion of the arm that remembers where the arm stood when it had ended at contact.

What is let go of there is let go of at contact only as long as the arm has not been moved since, by hand for example.
"""

from __future__ import annotations

from drivers.interfaces import Arm, ArmMotion, Vector


class GuardedMotion:
    """`motion` of `arm`; see `drivers.interfaces.ArmMotion`."""

    def __init__(self, motion: ArmMotion, arm: Arm) -> None:
        self.rest: Vector | None = None
        """Joint angles (6,) in rad after it had ended at contact, when that was first seen."""
        self._motion = motion
        self._arm = arm

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""
        return self._motion.done

    @property
    def contact(self) -> bool:
        """Whether it ended at its force limit."""
        return self._motion.contact

    def wait(self, timeout: float) -> None:
        """See `drivers.interfaces.Motion`."""
        self._motion.wait(timeout)
        if self.contact and self.rest is None:
            self.rest = self._arm.state().joints
