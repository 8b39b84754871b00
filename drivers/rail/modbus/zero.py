"""Whether a Modbus drive still counts from the zero that a homing found: by its own flag, and what speaks against it.

The flag goes off when the drive loses its zero; that it stands says neither who homed it nor under which settings.
"""

from __future__ import annotations

from drivers.clock import Clock
from drivers.errors import InterlockError
from drivers.quantities import shown
from drivers.rail.modbus.drive import ModbusDrive
from drivers.rail.motion import patience

BEGINS_S = 1.0
"""So long a drive may take to begin its search, or to say that it has lost the zero that it had."""
ZERO_M = 1e-3
"""How far from 0 a drive may say that it stands when its search has ended."""


class DriveZero:
    """The zero of `drive`. What happened to it while nobody watched is judged on connecting: with a fault, or at a
    limit switch, it is not trusted."""

    def __init__(self, drive: ModbusDrive, clock: Clock) -> None:
        registers = drive.registers
        self._drive = drive
        self._clock = clock
        self._seen = drive.says(registers.homed)
        self._distrusted = any(
            drive.says(flag) for flag in (registers.fault, registers.left_switch, registers.right_switch)
        )
        self._homed_since: float | None = None
        self.found_here = False
        """Whether this program saw the search end; what an earlier one found may be long ago."""

    def held(self, when: str = "since its last motion") -> bool:
        """Whether the drive, asked now, counts from a zero that a homing found.

        Raises `DeviceFault` (rail.reset), once, when it did before and does not any more.
        """
        homed = self._drive.says(self._drive.registers.homed)
        lost, self._seen = self._seen and not homed, homed
        if not homed:
            self.found_here = False
        if lost:
            raise self._drive.fault(
                "rail.reset",
                f"the drive has lost its zero {when}: it was reset or without power, or another program set it up",
                "Home the rail again; check the drive's supply.",
            )
        return homed and not self._distrusted

    def require(self, when: str = "since its last motion") -> None:
        """Raise unless `held`: `InterlockError` when it was never homed."""
        if not self.held(when):
            raise InterlockError(self._drive.name, "is not homed, so positions mean nothing yet. Call home() first")

    def forget(self) -> None:
        """The count can no longer be trusted by this program. Another one cannot be told."""
        self._distrusted, self.found_here = True, False

    def search(self, *, issued: int) -> None:
        """Begin the search for the reference switch."""
        self.forget()
        homed = self._drive.says(self._drive.registers.homed)
        self._homed_since = self._clock.now() if homed else None
        self._drive.link.do(self._drive.registers.home, issued=issued, moves=True)
        self._seen = False

    def found(self) -> bool:
        """Whether the search has ended at its zero.

        Raises `DeviceFault`: rail.not_begun when the drive does not begin, rail.alarm, and rail.setting when it counts
        from somewhere else.
        """
        drive, registers = self._drive, self._drive.registers
        homed, moving = drive.says(registers.homed), drive.says(registers.moving)
        if self._homed_since is not None:
            # It was homed before: until it moves, or says that it is not any more, that is no news.
            if moving or not homed:
                self._homed_since = None
            elif self._clock.now() - self._homed_since > patience(self._clock, BEGINS_S):
                raise drive.fault(
                    "rail.not_begun",
                    f"the drive has not begun to search its reference switch within {BEGINS_S:g} s",
                    "Check rail.registers.home, and that the drive is enabled.",
                )
            return False
        if drive.says(registers.fault):
            raise drive.alarmed("while it searched its reference switch")
        if moving or not homed:
            return False
        if abs(here := drive.position()[1]) > ZERO_M:
            raise drive.fault(
                "rail.setting",
                f"the drive has ended its search and counts {shown(here, 'm')} there (allowed ±{shown(ZERO_M, 'm')})",
                "Set its home offset to 0 and see that its position register starts there.",
            )
        self._seen = self.found_here = True
        self._distrusted = False
        return True
