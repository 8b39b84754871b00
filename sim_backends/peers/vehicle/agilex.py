"""The vehicle on its CAN bus: AgileX protocol v2, 500 kbit/s, Motorola byte order.

Encoded here from the protocol's description (docs/reference/protocols.md, section 3), independently of any DBC.
Feedback keeps its cycles in world time; in a fast world a frame is sent at most once per `_FAST` or `_SLOW` of wall
time, with the newest values.
"""

import math
import struct
import time
from collections.abc import Callable
from dataclasses import replace

from sim_backends.clock import WorldClock
from sim_backends.faults import FOREIGN_COMMANDS, SECOND_VEHICLE, VEHICLE_FAULTS
from sim_backends.models.vehicle import Mode, VehicleModel, VehicleParams, VehicleReadings
from sim_backends.peers.vehicle.slcan import CanFrame, CanPeer

MOTION_COMMAND, BRAKE, MOTION_MODE, VERSION_REQUEST, MODE, CLEAR = 0x111, 0x131, 0x141, 0x411, 0x421, 0x441
SYSTEM_STATE, MOTION_STATE, MOTION_MODE_STATE, ODOMETRY, BATTERY = 0x211, 0x221, 0x291, 0x311, 0x361
VERSION_NUMBERS, VERSION_TEXT = 0x41A, 0x4A1
MOTOR_MOTION, MOTOR_DRIVER = 0x251, 0x261

_FAST, _SLOW = 0.005, 0.020
_SLACK = 0.0025
"""Half of the time between two looks, s: without it a frame would wait for the next look again and again."""
_DRIVER_ENABLED = 0x40
_FOREIGN_FRAME = struct.pack(">hhhh", 200, 0, 0, 0)
"""What somebody else on the bus commands: 0.2 m/s ahead."""
_SECOND_AT_M = (12.0, 11.5)
"""Odometers, left and right, of the second vehicle, which stands."""
_SIDES = (1, -1, -1, 1)
"""Motors 1…4 are right front, left front, left rear, right rear: +1 right, −1 left."""

_Encoder = Callable[[VehicleReadings, VehicleParams, int], bytes]


class AgilexPeer(CanPeer):
    """The vehicle that speaks AgileX v2."""

    FAULTS = VEHICLE_FAULTS

    def __init__(self, model: VehicleModel, clock: WorldClock) -> None:
        super().__init__(model, clock)
        self._count = 0
        self._others: set[str] = set()
        """`FOREIGN_COMMANDS` and `SECOND_VEHICLE`, while they are on the bus."""
        self._schedule = [_Cyclic(identifier, *entry) for identifier, entry in _CYCLES.items()]

    def fault(self, name: str) -> None:
        """As `CanPeer`, and until `clear`: `can.refused_frames` is adapters that refuse every frame,
        `can.foreign_commands` somebody else who commands 0.2 m/s ahead, `can.second_vehicle` another vehicle that
        stands and reports under the same identifiers."""
        if name == "can.refused_frames":
            self._bus.refusing = True
        elif name in (FOREIGN_COMMANDS, SECOND_VEHICLE):
            self._others.add(name)
        else:
            super().fault(name)

    def clear(self) -> None:
        """Take away the vehicle's faults, and others from the bus."""
        self._others.clear()
        self._bus.refusing = False
        super().clear()

    def _tick(self, t: float) -> None:
        self.model.tick(t)
        feedback = self.model.feedback(t)
        frames = []
        for cyclic in self._schedule:
            if cyclic.due(t, time.monotonic()):
                self._count = (self._count + 1) & 0xFF
                frames.append(CanFrame(cyclic.id, cyclic.encode(feedback, self.model.params, self._count)))
                frames += self._of_others(cyclic, feedback)
        if frames:
            self._bus.send(frames)

    def _of_others(self, cyclic: "_Cyclic", feedback: VehicleReadings) -> list[CanFrame]:
        """What others put on the bus beside this frame of the vehicle's."""
        frames = []
        if SECOND_VEHICLE in self._others and cyclic.id in (SYSTEM_STATE, MOTION_STATE, ODOMETRY):
            left, right = _SECOND_AT_M
            second = replace(feedback, speed=0.0, yaw_rate=0.0, left=left, right=right)
            frames.append(CanFrame(cyclic.id, cyclic.encode(second, self.model.params, self._count)))
        if FOREIGN_COMMANDS in self._others and cyclic.id == MOTION_STATE:
            frames.append(CanFrame(MOTION_COMMAND, _FOREIGN_FRAME))
            self._receive(frames[-1])
        return frames

    def _receive(self, frame: CanFrame) -> None:
        if frame.extended or frame.remote or not frame.data:
            return
        if frame.id in (VERSION_REQUEST, VERSION_TEXT):
            self._tell_version(frame)
        else:
            self._obey(frame)

    def _obey(self, frame: CanFrame) -> None:
        t, model, first = self._clock.now(), self.model, frame.data[0]
        if frame.id == MOTION_COMMAND and len(frame.data) >= 4:
            speed, yaw_rate = struct.unpack_from(">hh", frame.data)
            model.command(t, speed / 1000.0, yaw_rate / 1000.0)
        elif frame.id == MODE and first in tuple(Mode):
            model.set_mode(t, Mode(first))
        elif frame.id == BRAKE and first in (0, 1):
            model.set_brake(t, first == 1)
        elif frame.id == MOTION_MODE:
            model.set_motion_mode(t, first)
        elif frame.id == CLEAR:
            model.clear_errors(t)

    def _tell_version(self, asked: CanFrame) -> None:
        versions = self.model.params.versions
        if asked.id == VERSION_REQUEST and asked.data[0] == 1:
            self._bus.send([CanFrame(VERSION_NUMBERS, struct.pack(">4H", *versions))])
        elif asked.id == VERSION_TEXT and asked.data == b"\x01":
            self._bus.send([CanFrame(VERSION_TEXT, part) for part in _version_text(versions)])


def _version_text(versions: tuple[int, int, int, int]) -> list[bytes]:
    """Ten frames of eight characters, as the maker's SDK reads them."""
    controller, driver, software, drivers = versions
    text = f"SIMULATED HW{controller}.{driver} CONTROLLER {software} DRIVERS {drivers}".encode("ascii").ljust(80)
    return [text[k : k + 8] for k in range(0, 80, 8)]


class _Cyclic:
    """A feedback frame with its cycle in world seconds and its shortest interval in wall seconds."""

    def __init__(self, identifier: int, cycle: float, interval: float, encode: _Encoder) -> None:
        self.id = identifier
        self.encode = encode
        self._cycle, self._interval = cycle, interval
        self._next = self._next_wall = -math.inf

    def due(self, t: float, wall: float) -> bool:
        """True when it is time to send, which is then counted as done."""
        if t < self._next or wall < self._next_wall:
            return False
        self._next = max(self._next + self._cycle, t - 0.5 * self._cycle)
        self._next_wall = wall + self._interval - _SLACK
        return True


def _system_state(f: VehicleReadings, p: VehicleParams, count: int) -> bytes:
    return bytes((f.state, f.mode)) + struct.pack(">HHxB", round(f.volts * 10.0), f.errors, count)


def _motion_state(f: VehicleReadings, p: VehicleParams, count: int) -> bytes:
    return struct.pack(">hhhh", _i16(f.speed * 1000.0), _i16(f.yaw_rate * 1000.0), 0, 0)


def _motion_mode_state(f: VehicleReadings, p: VehicleParams, count: int) -> bytes:
    return bytes([f.motion_mode, 0])


def _odometry(f: VehicleReadings, p: VehicleParams, count: int) -> bytes:
    return struct.pack(">ii", _i32(f.left * 1000.0), _i32(f.right * 1000.0))


def _battery(f: VehicleReadings, p: VehicleParams, count: int) -> bytes:
    charge, health = 87, 100
    return bytes((charge, health)) + struct.pack(">hhh", round(f.volts * 10.0), _i16(10.0 * _amperes(f.speed)), 250)


def _motor_motion(side: int) -> _Encoder:
    def encode(f: VehicleReadings, p: VehicleParams, count: int) -> bytes:
        rim = f.speed + side * 0.5 * p.track * f.yaw_rate
        turns = (f.right if side > 0 else f.left) / (2.0 * math.pi * p.wheel_radius)
        rpm = 60.0 * rim / (2.0 * math.pi * p.wheel_radius)
        return struct.pack(">hhi", _i16(rpm), _i16(2.5 * _amperes(rim)), _i32(turns * p.pulses_per_turn))

    return encode


def _motor_driver(motor: int) -> _Encoder:
    def encode(f: VehicleReadings, p: VehicleParams, count: int) -> bytes:
        return struct.pack(">HhbBxx", round(f.volts * 10.0), 31, 33, _DRIVER_ENABLED | f.drivers[motor])

    return encode


def _amperes(speed: float) -> float:
    return 1.0 + 8.0 * abs(speed)


def _i16(value: float) -> int:
    return min(max(round(value), -(2**15)), 2**15 - 1)


def _i32(value: float) -> int:
    return (round(value) + 2**31) % 2**32 - 2**31


_CYCLES: dict[int, tuple[float, float, _Encoder]] = {
    SYSTEM_STATE: (0.100, _FAST, _system_state),
    MOTION_STATE: (0.020, _FAST, _motion_state),
    ODOMETRY: (0.020, _FAST, _odometry),
    **{MOTOR_MOTION + i: (0.020, _SLOW, _motor_motion(side)) for i, side in enumerate(_SIDES)},
    **{MOTOR_DRIVER + i: (0.100, _SLOW, _motor_driver(i)) for i in range(len(_SIDES))},
    MOTION_MODE_STATE: (0.100, _SLOW, _motion_mode_state),
    BATTERY: (0.500, _SLOW, _battery),
}
"""Feedback frames: id → (cycle in world s, shortest interval in wall s, encoder)."""
