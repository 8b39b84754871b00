"""One drive of a wheel after CiA 402, in profile velocity mode: its state machine and its ramps; no bytes.

Written from the profile (IEC 61800-7-201), not from the driver. Speeds are those of the wheel's rim, m/s, ahead
positive.
"""

from __future__ import annotations

from enum import Enum

STANDS = 0.003
"""A wheel that turns no faster counts as at rest, m/s."""


class WheelState(Enum):
    """State with the bits 0 to 3, 5 and 6 of the statusword that show it."""

    DISABLED = 0x40
    READY = 0x21
    SWITCHED_ON = 0x23
    ENABLED = 0x27
    QUICK_STOP = 0x07
    REACTING = 0x0F
    FAULT = 0x08


class WheelDrive:
    """A drive that was just switched on. `stays` tells how its quick stop ends: at rest with or without power.

    `connection_lost_as` is what it does when its master is gone: 0 nothing, 1 fault, 2 without power, 3 quick stop.
    """

    def __init__(self) -> None:
        self.state = WheelState.DISABLED
        self.acceleration = self.deceleration = self.quick_deceleration = 0.5
        self.target = 0.0
        self.mode = 0
        self.quick_stop_option = 2
        self.connection_lost_as = 1
        self.powered = True
        """Whether its power stage has voltage."""
        self.demand = 0.0
        """Speed that the ramp asks for now."""
        self.speed = 0.0
        """Speed at which the wheel turns."""
        self._word = 0

    @property
    def energised(self) -> bool:
        """Whether it holds or turns its motor."""
        return self.state in (WheelState.ENABLED, WheelState.QUICK_STOP, WheelState.REACTING)

    @property
    def hard(self) -> bool:
        """Whether it stops on the steep ramp."""
        return self.state in (WheelState.QUICK_STOP, WheelState.REACTING)

    @property
    def statusword(self) -> int:
        """Bits 4 voltage, 9 remote, 10 target reached, 12 at rest besides those of the state."""
        reached = self.state is WheelState.ENABLED and abs(self.speed - self.target) < STANDS
        resting = abs(self.speed) < STANDS
        quick = 0 if self.state is WheelState.QUICK_STOP else 0x20
        bits = self.state.value | (quick if self.state in (WheelState.DISABLED, WheelState.FAULT) else 0)
        return bits | self.powered << 4 | 1 << 9 | reached << 10 | resting << 12

    def control(self, word: int) -> bool:
        """Obey a controlword; True when it reset a fault."""
        rising, self._word = word & ~self._word, word
        if self.state is WheelState.FAULT:
            if rising & 0x80:
                self.state = WheelState.DISABLED
                return True
            return False
        if self.state is WheelState.REACTING:
            return False
        if not word & 0x02:
            self._rest(WheelState.DISABLED)
        elif not word & 0x04:
            if self.state is WheelState.ENABLED:
                self.state = WheelState.QUICK_STOP
            elif self.state is not WheelState.QUICK_STOP:
                self._rest(WheelState.DISABLED)
        elif self.state is WheelState.QUICK_STOP:
            if word & 0x0F == 0x0F and self.quick_stop_option in (5, 6, 7, 8):
                self.state = WheelState.ENABLED
        elif self.powered:
            self._switch(word & 0x0F)
        return False

    def _switch(self, command: int) -> None:
        shutdown, on, enable = command & 0x07 == 0x06, command & 0x0F == 0x07, command & 0x0F == 0x0F
        if shutdown and self.state in (WheelState.DISABLED, WheelState.SWITCHED_ON, WheelState.ENABLED):
            self._rest(WheelState.READY)
        elif on and self.state in (WheelState.READY, WheelState.ENABLED):
            self._rest(WheelState.SWITCHED_ON)
        elif enable and self.state in (WheelState.READY, WheelState.SWITCHED_ON):
            self.state = WheelState.ENABLED

    def fault(self) -> None:
        """Something failed: stop on the steep ramp, then without power."""
        if self.state is not WheelState.FAULT:
            self.state = WheelState.REACTING if self.energised else WheelState.FAULT

    def connection_lost(self) -> None:
        """Its master is gone."""
        if self.connection_lost_as == 1:
            self.fault()
        elif self.connection_lost_as == 2:
            self._rest(WheelState.DISABLED)
        elif self.connection_lost_as == 3 and self.state is WheelState.ENABLED:
            self.state = WheelState.QUICK_STOP

    def power(self, on: bool) -> None:
        """Voltage comes or goes at the power stage, as with an emergency stop."""
        self.powered = on
        if not on and self.state not in (WheelState.FAULT, WheelState.DISABLED):
            self._rest(WheelState.DISABLED)

    def step(self, dt: float, speed: float) -> None:
        """Let `dt` seconds pass; the wheel turns at `speed` now."""
        self.speed = speed
        halted = bool(self._word & 0x100)
        wanted = self.target if self.state is WheelState.ENABLED and self.mode == 3 and not halted else 0.0
        slowing = abs(wanted) < abs(self.demand) or wanted * self.demand < 0.0
        ramp = self.quick_deceleration if self.hard else self.deceleration if slowing else self.acceleration
        self.demand += min(max(wanted - self.demand, -ramp * dt), ramp * dt)
        if self.hard and self.demand == 0.0 and abs(speed) < STANDS:
            if self.state is WheelState.REACTING:
                self._rest(WheelState.FAULT)
            elif self.quick_stop_option not in (5, 6, 7, 8):
                self._rest(WheelState.DISABLED)

    def _rest(self, state: WheelState) -> None:
        self.state = state
        self.demand = 0.0
