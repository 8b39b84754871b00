"""Whether the module still counts from the zero that a homing found: a mark in its memory that a reset takes away.

The mark is a user variable of the module. Variables 0 to 55 come back from the EEPROM at power-on, the others live in
RAM only (TMCL firmware manual of the TMCM-1260, global parameters, bank 2): as long as the mark stands, the step
counter has not been lost either. Its value names the settings that the counter is read with, so that no program takes
the zero of another one.
"""

from __future__ import annotations

import logging
import zlib

from drivers.errors import CellError, DeviceFault, InterlockError
from drivers.rail.tmcl.codec import Axis
from drivers.rail.tmcl.link import TmclLink

MARK_VARIABLE = 200
"""User variable that holds the mark: in RAM only."""
_NONE, _SEARCHING = 0, 1
STALL_FLAG = 1
_HOME_SWITCH_MODES = range(5, 9)
_MODE_BITS = 0x3F
"""Without the bits that swap the sides (64) and turn the home switch's polarity round (128)."""

_log = logging.getLogger(__name__)


class ZeroMark:
    """The mark on the module behind `link`.

    `settings` are what a position in counts depends on; a module set up by other ones is not homed for this program.
    """

    def __init__(self, link: TmclLink, settings: tuple[object, ...]) -> None:
        self._link = link
        self._value = zlib.crc32(repr(settings).encode()) % 0x7FFF_FFF0 + 2
        self._seen = False
        self._distrusted = False
        self.found_here = False
        """Whether this program saw the search end; what an earlier one found may be long ago."""

    def meet(self, microstep_resolution: int, reference_mode: int, *, mark: bool = True) -> None:
        """On connecting, before anything is set: take the mark away unless it is this program's and nothing speaks
        against it that happened while nobody watched: another resolution, a stall, a limit switch.

        Without `mark` the module is left as it is; its zero is not trusted here all the same.
        """
        link = self._link
        if link.user_variable(MARK_VARIABLE) == self._value:
            switches = (
                (Axis.LEFT_SWITCH, Axis.RIGHT_SWITCH) if reference_mode & _MODE_BITS in _HOME_SWITCH_MODES else ()
            )
            self._seen = not (
                link.get(Axis.MICROSTEP_RESOLUTION) != microstep_resolution
                or link.get(Axis.EXTENDED_ERRORS) & STALL_FLAG
                or any(link.get(switch) for switch in switches)
            )
            if not self._seen:
                _log.warning("%s: stalled, at a limit switch or set up anew since its homing; not homed", link.name)
        if mark and not self._seen:
            link.set_user_variable(MARK_VARIABLE, _NONE)
        self._distrusted = not mark and not self._seen

    def searching(self, *, issued: int) -> None:
        """A reference search begins: no zero until it has been found."""
        self._seen = self.found_here = False
        self._link.set_user_variable(MARK_VARIABLE, _SEARCHING, issued=issued)
        self._distrusted = False

    def found(self, *, issued: int) -> None:
        """The search has ended. `DeviceFault` (rail.reset) when the module was reset meanwhile: that, too, ends it."""
        if self._link.user_variable(MARK_VARIABLE) != _SEARCHING:
            raise self._lost("while it searched the reference switch")
        self._link.set_user_variable(MARK_VARIABLE, self._value, issued=issued)
        self._seen = self.found_here = True

    def held(self) -> bool:
        """Whether the module, asked now, counts from a zero that a homing of this configuration found.

        Raises `DeviceFault` (rail.reset), once, when it did before and does not any more.
        """
        if self._distrusted:
            return False
        held = self._link.user_variable(MARK_VARIABLE) == self._value
        if self._seen and not held:
            raise self._lost("since its last motion")
        self._seen = held
        return held

    def require(self) -> None:
        """Raise unless `held`: `InterlockError` when it was never homed."""
        if not self.held():
            raise InterlockError(self._link.name, "is not homed, so positions mean nothing yet. Call home() first")

    def require_still(self) -> None:
        """Raise `DeviceFault` (rail.reset) unless `held`: for a motion that began when it was."""
        if not self.held():
            raise self._lost("in its motion")

    def forget(self) -> None:
        """The count can no longer be trusted: neither by this program nor by another one."""
        self._seen, self._distrusted = False, True
        try:
            self._link.set_user_variable(MARK_VARIABLE, _NONE)
        except CellError as error:
            _log.warning("%s: the module could not be told that its zero is lost: %s", self._link.name, error)

    def _lost(self, when: str) -> DeviceFault:
        self._seen = False
        return DeviceFault(
            self._link.name,
            "rail.reset",
            f"the module has lost its zero {when}: it was reset or without power, or another program set it up",
            recoverable=True,
            hint="Home the rail again; check the module's supply.",
        )
