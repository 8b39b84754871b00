"""The skid-steered vehicle: accelerations, slip, command time-out, brake and emergency stop; no bytes.

The wheels do what the controller commands; the ground turns that into motion with a scale error, a yaw error and a
small random walk, which odometry cannot see.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sim_backends.clock import History
from sim_backends.faults import VEHICLE_MODEL_FAULTS as FAULTS

_STEP = 0.005
MOTOR_FAULT = 0x0100
"""Error bit of the system state: a motor driver fails (ugv_sdk, SYSTEM_ERROR_MOTOR_DRIVER_MASK)."""
DRIVER_FAULT, DRIVER_OVERLOAD = 0x20, 0x04
"""Bits of a motor driver's status (ugv_sdk, DRIVER_STATE_…)."""
MOTORS = 4


class ChassisState(IntEnum):
    """Vehicle state as reported."""

    OK = 0
    EMERGENCY_STOP = 1
    EXCEPTION = 2


class Mode(IntEnum):
    """Who commands the vehicle."""

    STANDBY = 0
    CAN = 1
    UART = 2


@dataclass(frozen=True)
class VehicleParams:
    """Hardware of one vehicle, SI units. `start` is x, y, yaw in the world at time 0.

    `distance_scale` and `yaw_scale` are true motion per wheel motion; `lateral_walk` (m/√m) and `yaw_walk` (rad/√m)
    are random walks over the way of the wheels. `versions` are controller and driver hardware, then their software.
    """

    start: tuple[float, float, float] = (-3.05, 0.0, 0.0)
    max_speed: float = 1.5
    max_yaw_rate: float = 1.0
    acceleration: float = 0.6
    yaw_acceleration: float = 1.2
    brake_deceleration: float = 2.5
    track: float = 0.583
    wheel_radius: float = 0.165
    distance_scale: float = 1.0
    yaw_scale: float = 1.0
    lateral_walk: float = 0.0
    yaw_walk: float = 0.0
    command_timeout: float = 0.5
    pulses_per_turn: int = 4096
    battery_volts: float = 26.4
    versions: tuple[int, int, int, int] = (2, 1, 204, 110)


@dataclass(frozen=True)
class VehicleReadings:
    """What the vehicle knows of itself: speeds in m/s and rad/s of the wheels, odometers of both sides in m. `drivers`
    is the status of each motor's driver."""

    state: ChassisState
    mode: Mode
    motion_mode: int
    braked: bool
    errors: int
    volts: float
    speed: float
    yaw_rate: float
    left: float
    right: float
    drivers: tuple[int, ...] = (0,) * MOTORS


class VehicleModel:
    """One vehicle. All times are world seconds; safe between threads.

    `sag` may be set to a function that gives roll, pitch (rad) and height (m) of the body on its suspension; it is
    asked in `tick` and never while the model is locked. `blocked` may be set to a function that is told the pose (x, y,
    yaw) that the next step leads to, and says whether something solid is in the way: the vehicle then stays where it
    is, its motors are overloaded and it reports an exception. It is asked while the model is locked.
    """

    def __init__(self, params: VehicleParams, rng: np.random.Generator) -> None:
        """A vehicle that was switched on at world time 0, in standby, brake released."""
        self.params = params
        self.sag: Callable[[], tuple[float, float, float]] = lambda: (0.0, 0.0, 0.0)
        self.blocked: Callable[[float, tuple[float, float, float]], bool] = lambda t, pose: False
        self._rng = rng
        self._lock = threading.Lock()
        self._history = History()
        self._t = 0.0
        self._x, self._y, self._yaw = params.start
        self._tilt = (0.0, 0.0, 0.0)
        self._speed = self._yaw_rate = 0.0
        self._left = self._right = 0.0
        self._command = (0.0, 0.0)
        self._commanded_at = -math.inf
        self._hard = False
        self._mode = Mode.STANDBY
        self._motion_mode = 0
        self._braked = False
        self._emergency = False
        self._errors = 0
        self._drivers = [0] * MOTORS
        self._history.append(0.0, self._pose())

    def tick(self, t: float) -> None:
        """Let time pass until world time `t`, taking the suspension's sag as it is now."""
        tilt = self.sag()
        with self._lock:
            self._advance(t)
            self._tilt = tilt
            self._history.append(self._t, self._pose())

    def world_from_vehicle(self, t: float) -> NDArray[np.float64]:
        """True pose (4, 4) of the vehicle frame at world time `t`, which must not lie in the future."""
        with self._lock:
            self._advance(t)
        return self._history.at(t)

    def planar(self, t: float) -> tuple[float, float, float]:
        """True x, y in m and yaw in rad at the newest time known, at least `t`."""
        with self._lock:
            self._advance(t)
            return self._x, self._y, self._yaw

    def feedback(self, t: float) -> VehicleReadings:
        """What the vehicle reports at world time `t`."""
        with self._lock:
            self._advance(t)
            return VehicleReadings(
                self._state(), self._mode, self._motion_mode, braked=self._braked, errors=self._errors,
                volts=self.params.battery_volts, speed=self._speed, yaw_rate=self._yaw_rate, left=self._left,
                right=self._right, drivers=tuple(self._drivers),
            )  # fmt: skip

    def set_mode(self, t: float, mode: Mode) -> None:
        """Choose who commands; any change stops the vehicle."""
        with self._lock:
            self._advance(t)
            if mode is not self._mode:
                self._command = (0.0, 0.0)
            self._mode = mode

    def set_motion_mode(self, t: float, motion_mode: int) -> None:
        """Choose the kinematic mode; a skid-steered vehicle drives the same in all of them."""
        with self._lock:
            self._advance(t)
            self._motion_mode = motion_mode

    def command(self, t: float, speed: float, yaw_rate: float, hard: bool = False) -> None:
        """Drive at `speed` m/s and `yaw_rate` rad/s until `command_timeout` has passed; ignored outside CAN mode. With
        `hard` it slows down as its brakes would slow it."""
        p = self.params
        with self._lock:
            self._advance(t)
            if self._mode is not Mode.CAN:
                return
            self._command = (
                min(max(speed, -p.max_speed), p.max_speed),
                min(max(yaw_rate, -p.max_yaw_rate), p.max_yaw_rate),
            )
            self._commanded_at = t
            self._hard = hard

    def set_brake(self, t: float, locked: bool) -> None:
        """Lock (stopping hard if moving) or release the brake."""
        with self._lock:
            self._advance(t)
            self._braked = locked

    def clear_errors(self, t: float) -> None:
        """Clear stored errors; an emergency stop stays until its button is released."""
        with self._lock:
            self._advance(t)
            self._clear()

    def fault(self, name: str, t: float) -> None:
        """Cause a fault of `FAULTS`. Raises ValueError for another name."""
        if name not in FAULTS:
            raise ValueError(f"unknown vehicle fault {name!r}; known: {', '.join(FAULTS)}")
        with self._lock:
            self._advance(t)
            if name == "vehicle.emergency_stop":
                self._emergency = True
            else:
                self._errors |= MOTOR_FAULT
                self._drivers[0] |= DRIVER_FAULT

    def push(self, t: float, x: float, y: float, yaw: float) -> None:
        """As when somebody bumps into it: by so many m and rad, wheels and odometry do not turn."""
        with self._lock:
            self._advance(t)
            self._x, self._y, self._yaw = self._x + x, self._y + y, self._yaw + yaw
            self._history.append(self._t, self._pose())

    def clear(self, t: float) -> None:
        """Take away all causes of faults: the emergency stop button is released, motors are well again."""
        with self._lock:
            self._advance(t)
            self._emergency = False
            self._clear()

    def _clear(self) -> None:
        self._errors = 0
        self._drivers = [0] * MOTORS

    def _state(self) -> ChassisState:
        if self._emergency:
            return ChassisState.EMERGENCY_STOP
        return ChassisState.EXCEPTION if self._errors else ChassisState.OK

    def _advance(self, t: float) -> None:
        while self._t < t:
            if self._speed == self._yaw_rate == 0.0 and self._wanted(self._t) == (0.0, 0.0):
                self._t = t
            else:
                self._step(min(_STEP, t - self._t))
            self._history.append(self._t, self._pose())

    def _wanted(self, t: float) -> tuple[float, float]:
        silent = t - self._commanded_at >= self.params.command_timeout
        if silent or self._braked or self._mode is not Mode.CAN or self._state() is not ChassisState.OK:
            return 0.0, 0.0
        return self._command

    def _step(self, dt: float) -> None:
        p = self.params
        speed, yaw_rate = self._wanted(self._t)
        hard = self._braked or self._emergency or self._hard
        linear = p.brake_deceleration if hard else p.acceleration
        turning = linear / (0.5 * p.track) if hard else p.yaw_acceleration
        old_speed, old_yaw_rate = self._speed, self._yaw_rate
        self._speed += min(max(speed - old_speed, -linear * dt), linear * dt)
        self._yaw_rate += min(max(yaw_rate - old_yaw_rate, -turning * dt), turning * dt)
        way = 0.5 * (old_speed + self._speed) * dt
        turn = 0.5 * (old_yaw_rate + self._yaw_rate) * dt
        rolled = math.sqrt(abs(way) + 0.5 * p.track * abs(turn))
        true_way, true_turn = way * p.distance_scale, turn * p.yaw_scale
        lateral = 0.0
        if p.yaw_walk:
            true_turn += p.yaw_walk * rolled * float(self._rng.standard_normal())
        if p.lateral_walk:
            lateral = p.lateral_walk * rolled * float(self._rng.standard_normal())
        heading = self._yaw + 0.5 * true_turn
        self._t += dt
        x = self._x + true_way * math.cos(heading) - lateral * math.sin(heading)
        y = self._y + true_way * math.sin(heading) + lateral * math.cos(heading)
        if self.blocked(self._t, (x, y, self._yaw + true_turn)):
            self._speed = self._yaw_rate = 0.0
            self._errors |= MOTOR_FAULT
            self._drivers = [status | DRIVER_OVERLOAD for status in self._drivers]
            return
        self._x, self._y, self._yaw = x, y, self._yaw + true_turn
        self._left += way - 0.5 * p.track * turn
        self._right += way + 0.5 * p.track * turn

    def _pose(self) -> NDArray[np.float64]:
        roll, pitch, height = self._tilt
        cy, sy = math.cos(self._yaw), math.sin(self._yaw)
        cp, sp = math.cos(pitch), math.sin(pitch)
        cr, sr = math.cos(roll), math.sin(roll)
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, self._x],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, self._y],
                [-sp, cp * sr, cp * cr, height],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
