"""What one wheel drive has told last."""

from __future__ import annotations

import math
import struct

from drivers.vehicle.cia402.emergencies import meaning
from drivers.vehicle.cia402.objects import (
    BOOTED,
    EMERGENCY,
    HEALTH,
    HEARTBEAT,
    MOTION,
    NMT_STATES,
    OPERATIONAL,
    PROFILE_VELOCITY,
    STATUS,
)
from drivers.vehicle.cia402.states import REMOTE, VOLTAGE, WARNING, DriveState, state_of

_KEPT = 4
"""Emergencies of which each is told."""


class SideDrive:
    """The drive of one side; filled through `take`, by whoever holds the lock. Times are host times in s."""

    def __init__(self, side: str, node: int) -> None:
        self.side = side
        self.node = node
        self.statusword = self.position = self.velocity = self.mode = self.inputs = self.code = 0
        self.millivolts: int | None = None
        self.told = self.moved = self.beaten = -math.inf
        """When status and position, velocity, and its heartbeat came last."""
        self.nmt: int | None = None
        self.emergencies: list[int] = []
        """Codes since its last fault was reset."""
        self.configured = False
        """Whether it is set up; a drive that was switched off is not any more."""
        self.quiet = 0.0
        """Wall seconds for which nothing of it was heard."""
        self.waited = 0
        """How many times it was asked to tell its state since it did last."""

    @property
    def state(self) -> DriveState:
        """By the newest statusword."""
        return state_of(self.statusword)

    def take(self, service: int, data: bytes, now: float) -> bool:
        """Take a frame; True when it restarted. Raises ValueError for one of another length."""
        self.quiet = 0.0
        try:
            return self._take(service, data, now)
        except struct.error as error:
            raise ValueError(f"{service:03X}h of {len(data)} bytes") from error

    def _take(self, service: int, data: bytes, now: float) -> bool:
        if service == STATUS:
            self.statusword, self.position, self.mode = struct.unpack("<Hib", data)
            self.told, self.waited = now, 0
        elif service == MOTION:
            (self.velocity,) = struct.unpack_from("<i", data)
            if len(data) == 8:
                (self.inputs,) = struct.unpack_from("<I", data, 4)
            self.moved = now
        elif service == HEALTH:
            (self.code,) = struct.unpack_from("<H", data)
            if len(data) == 6:
                (self.millivolts,) = struct.unpack_from("<I", data, 2)
        elif service == EMERGENCY:
            code, _ = struct.unpack_from("<HB", data)
            if code & 0xFF00 == 0:
                self.emergencies.clear()
            elif code not in self.emergencies:
                self.emergencies = [*self.emergencies, code][-_KEPT:]
        elif service == HEARTBEAT:
            # Bit 7 is the toggle of node guarding.
            self.nmt, self.beaten = data[0] & 0x7F, now
            if self.nmt == BOOTED:
                restarted, self.configured = self.configured, False
                self.emergencies.clear()
                return restarted
        return False

    def trouble(self) -> tuple[str, ...]:
        """What of it ends motion, in words; empty when there is nothing."""
        found = []
        if self.state in (DriveState.FAULT, DriveState.REACTING):
            codes = self.emergencies or [self.code]
            found += [f"{self.side} drive: {meaning(code)}" for code in codes]
        return tuple(found)

    def left_command(self) -> str:
        """Why a drive that was enabled does not obey any more though it has no fault; "" when it obeys."""
        if not self.configured:
            return f"the {self.side} drive was restarted"
        if self.nmt is not None and self.nmt != OPERATIONAL:
            return f"the {self.side} drive is {NMT_STATES.get(self.nmt, f'in NMT state {self.nmt}')} on the bus"
        if not self.statusword & REMOTE:
            return f"the {self.side} drive is commanded locally (statusword {self.statusword:04X}h, bit 9)"
        if self.mode != PROFILE_VELOCITY:
            return f"the {self.side} drive is in mode {self.mode} instead of {PROFILE_VELOCITY}, profile velocity"
        if self.state is not DriveState.ENABLED:
            dead = ", without voltage" if not self.statusword & VOLTAGE else ""
            return f"the {self.side} drive left operation and is {self.state.value}{dead}"
        return ""

    def warnings(self) -> tuple[str, ...]:
        """What it says that does not end motion."""
        return (f"the {self.side} drive warns (statusword bit 7)",) if self.statusword & WARNING else ()
