"""A vehicle of two wheel drives on CANopen: CiA 301 and CiA 402 on an slcan adapter, 500 kbit/s.

Encoded here from the profiles (CiA 402: IEC 61800-7-201), without any CANopen library, not from the driver. The wheels'
ramps are the drives'; the body cannot follow faster than it does under any driver. Speeds are those of the wheel's rim,
m/s, ahead positive.
"""

import math
import threading
import time
from dataclasses import dataclass
from enum import Enum
from functools import partial

from sim_backends.clock import WorldClock
from sim_backends.faults import VEHICLE_MODEL_FAULTS
from sim_backends.models.vehicle import DRIVER_OVERLOAD, ChassisState, Mode, VehicleModel
from sim_backends.peers.vehicle.canopen_node import WRONG_VALUE, Abort, CanopenNode, Value
from sim_backends.peers.vehicle.slcan import CanFrame, CanPeer

_TURNS = {"rpm": 1 / 60, "0.1 rpm": 1 / 600, "0.01 rpm": 1 / 6000, "0.001 rpm": 1 / 60000}
_UNITS = {"counts/s": (0, 0xB5, 0x03), "rpm": (0, 0xB4, 0x47), "0.1 rpm": (0xFF, 0xB4, 0x47),
          "0.01 rpm": (0xFE, 0xB4, 0x47), "0.001 rpm": (0xFD, 0xB4, 0x47)}  # fmt: skip
_MOTORS = ((1, 2), (0, 3))
"""The vehicle's motors of the left and the right drive."""
CURRENT, BLOCKED = 0x2310, 0x7121
"""Emergency codes: the motor takes too much current; it is blocked."""


@dataclass(frozen=True)
class CanopenSettings:
    """The drives as a configuration describes them; lengths in m. See the configuration's keys of these names.
    `brake_bit` and `stop_bit` are bits of outputs and inputs, or None."""

    left_node: int = 1
    right_node: int = 2
    wheel_radius: float = 0.1
    gear: float = 20.0
    counts_per_turn: int = 4096
    velocity_unit: str = "0.1 rpm"
    left_reversed: bool = False
    right_reversed: bool = True
    brake_bit: int | None = None
    brake_locks: bool = False
    stop_bit: int | None = None
    stop_active: bool = True


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
    `connection_lost_as` is what it does when its master is gone: 0 nothing, 1 fault, 2 without power, 3 quick stop."""

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


class CanopenPeer(CanPeer):
    """The two drives, and the vehicle that they move."""

    FAULTS = ("can.bus_off", "can.node_lost", *VEHICLE_MODEL_FAULTS)

    def __init__(self, model: VehicleModel, clock: WorldClock, settings: CanopenSettings) -> None:
        super().__init__(model, clock)
        self._lock = threading.RLock()
        self.drives = (
            DriveNode(self, settings, settings.left_node, settings.left_reversed, -1),
            DriveNode(self, settings, settings.right_node, settings.right_reversed, 1),
        )
        self._t = clock.now()
        model.set_mode(self._t, Mode.CAN)

    def _run(self) -> None:
        with self._lock:
            for drive in self.drives:
                drive.node.boot()
        super()._run()

    def fault(self, name: str) -> None:
        """As `CanPeer`; `can.node_lost`: the left drive hears and says nothing any more."""
        if name == "can.node_lost":
            self.drives[0].node.silent = True
        else:
            super().fault(name)

    def clear(self) -> None:
        """Take away the causes of faults."""
        super().clear()
        with self._lock:
            for drive in self.drives:
                drive.node.silent = False

    def send(self, frame: CanFrame) -> None:
        """A drive says something."""
        self._bus.send([frame])

    def _tick(self, t: float) -> None:
        with self._lock:
            self._advance(t)

    def _advance(self, t: float) -> None:
        dt, self._t = t - self._t, t
        self.model.tick(t)
        told = self.model.feedback(t)
        for drive, motors in zip(self.drives, _MOTORS, strict=True):
            drive.wheel.power(told.state is not ChassisState.EMERGENCY_STOP)
            if bits := told.drivers[motors[0]] | told.drivers[motors[1]]:
                drive.fault(BLOCKED if bits & DRIVER_OVERLOAD else CURRENT)
            drive.wheel.step(dt, told.speed + drive.side * 0.5 * self.model.params.track * told.yaw_rate)
            drive.node.tick(time.monotonic())
        left, right = (drive.wheel for drive in self.drives)
        self.model.command(
            t, 0.5 * (left.demand + right.demand), (right.demand - left.demand) / self.model.params.track,
            left.hard or right.hard,
        )  # fmt: skip
        # One wheel that is locked holds the vehicle.
        locked = any(drive.locked for drive in self.drives)
        if locked != told.braked:
            self.model.set_brake(t, locked)

    def _receive(self, frame: CanFrame) -> None:
        with self._lock:
            for drive in self.drives:
                drive.node.receive(frame, time.monotonic())

    def now(self) -> float:
        """World time."""
        return self._clock.now()


class DriveNode:
    """One drive on the bus: a wheel drive behind its object dictionary."""

    def __init__(self, peer: CanopenPeer, settings: CanopenSettings, number: int, backwards: bool, side: int) -> None:
        self.wheel = WheelDrive()
        self.side = side
        self._peer, self._settings = peer, settings
        self._sign = -1 if backwards else 1
        self._outputs = self._mask = 0
        self._code = 0
        texts = {(0x1008, 0): b"Simulated wheel drive", (0x100A, 0): b"1.4"}
        self.node = CanopenNode(number, self._values(number), texts, peer.send, self._alone)

    @property
    def locked(self) -> bool:
        """Whether its brake is locked: by its output, or else whenever its motor is not held."""
        bit = self._settings.brake_bit
        if bit is None:
            return not self.wheel.energised
        return bool(self._outputs & self._mask & 1 << bit) == self._settings.brake_locks

    def fault(self, code: int) -> None:
        """It fails, and says so once."""
        if self._code != code:
            self._code = code
            self.wheel.fault()
            self.node.emergency(code)

    def _alone(self) -> None:
        self._code = 0x8130
        self.wheel.connection_lost()

    def _values(self, number: int) -> dict[tuple[int, int], Value]:
        wheel, settings = self.wheel, self._settings
        prefix, numerator, denominator = _UNITS[settings.velocity_unit]

        def ramp(name: str) -> Value:
            def write(value: int) -> None:
                if not value:
                    raise Abort(WRONG_VALUE)
                setattr(wheel, name, value * self._rim_per_unit)

            return Value("<I", round(0.5 / self._rim_per_unit), writable=True, write=write)

        def option(form: str, value: int, allowed: tuple[int, ...], name: str = "") -> Value:
            def write(wanted: int) -> None:
                if wanted not in allowed:
                    raise Abort(WRONG_VALUE)
                if name:
                    setattr(wheel, name, wanted)

            return Value(form, value, writable=True, write=write)

        return {
            (0x1000, 0): Value("<I", 0x00020192), (0x1018, 0): Value("<B", 4), (0x1018, 1): Value("<I", 0x0000031F),
            (0x1018, 2): Value("<I", 402), (0x1018, 3): Value("<I", 0x00010004),
            (0x1018, 4): Value("<I", 7000 + number),
            (0x6007, 0): option("<h", 1, (0, 1, 2, 3), name="connection_lost_as"),
            (0x603F, 0): Value("<H", mappable=True, read=lambda: self._code),
            (0x6040, 0): Value("<H", writable=True, mappable=True, write=self._control),
            (0x6041, 0): Value("<H", mappable=True, read=lambda: wheel.statusword),
            (0x605A, 0): option("<h", 2, (1, 2, 5, 6), name="quick_stop_option"), (0x605D, 0): option("<h", 1, (1, 2)),
            (0x605E, 0): option("<h", 2, (0, 1, 2)), (0x6060, 0): option("<b", 0, (0, 3), name="mode"),
            (0x6061, 0): Value("<b", mappable=True, read=lambda: wheel.mode),
            (0x6064, 0): Value("<i", mappable=True, read=self._position),
            (0x606C, 0): Value("<i", mappable=True, read=lambda: round(self._sign * wheel.speed / self._rim_per_unit)),
            (0x6079, 0): Value("<I", mappable=True, read=lambda: round(1e3 * self._peer.model.params.battery_volts)),
            (0x6083, 0): ramp("acceleration"), (0x6084, 0): ramp("deceleration"),
            (0x6085, 0): ramp("quick_deceleration"), (0x608F, 0): Value("<B", 2),
            (0x608F, 1): Value("<I", settings.counts_per_turn), (0x608F, 2): Value("<I", 1),
            (0x60A9, 0): Value("<I", prefix << 24 | numerator << 16 | denominator << 8),
            (0x60FD, 0): Value("<I", mappable=True, read=self._inputs), (0x60FE, 0): Value("<B", 2),
            (0x60FE, 1): Value("<I", writable=True, mappable=True, write=partial(setattr, self, "_outputs")),
            (0x60FE, 2): Value("<I", writable=True, write=partial(setattr, self, "_mask")),
            (0x60FF, 0): Value("<i", writable=True, mappable=True, write=self._aim),
            (0x6502, 0): Value("<I", 0x00000005),
        }  # fmt: skip

    @property
    def _turn(self) -> float:
        """Way of the rim per turn of the motor, m."""
        return 2.0 * math.pi * self._settings.wheel_radius / self._settings.gear

    @property
    def _rim_per_unit(self) -> float:
        """Speed of the rim per unit of velocity, m/s."""
        unit = self._settings.velocity_unit
        return self._turn / self._settings.counts_per_turn if unit == "counts/s" else self._turn * _TURNS[unit]

    def _control(self, word: int) -> None:
        if self.wheel.control(word):
            self._code = 0
            self._peer.model.clear_errors(self._peer.now())
            self.node.emergency(0)

    def _aim(self, target: int) -> None:
        self.wheel.target = self._sign * target * self._rim_per_unit

    def _position(self) -> int:
        told = self._peer.model.feedback(self._peer.now())
        way = told.right if self.side > 0 else told.left
        return round(self._sign * way / self._turn * self._settings.counts_per_turn)

    def _inputs(self) -> int:
        if self._settings.stop_bit is None:
            return 0
        return (self.wheel.powered != self._settings.stop_active) << self._settings.stop_bit
