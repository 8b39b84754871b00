"""The vehicle in this process: commands in steps of 1 mm/s and 1 mrad/s, odometry in those that its bus carries."""

import math
from dataclasses import dataclass

from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError, InterlockError, check_range
from drivers.interfaces import Identity, VehicleState
from drivers.vehicle.faults import system_trouble, vehicle_error, vehicle_fault
from drivers.vehicle.feedback import PlanarOdometry
from sim_backends.direct.switches import DirectDevice
from sim_backends.models.vehicle import ChassisState, Mode, VehicleModel

KEEP_ALIVE_S = 0.020
DEAD_MAN_S = 0.5
"""A velocity that has not been renewed for this long is replaced by zero."""
STOP_TIMEOUT_S = 4.0
REST_AFTER_S = 4.0
"""After its last command to move the vehicle stands within this."""
_STILL = 0.002
_FARTHEST_M = 0.5


@dataclass(frozen=True)
class VehicleSetup:
    """Limits in m/s and rad/s; its wheels are `track` m apart, `count` is the way, m, that its counters count in.
    `make` is what it calls itself."""

    max_speed: float
    max_yaw_rate: float
    track: float
    make: str
    count: float


class DirectVehicle(DirectDevice):
    """The vehicle `model`; see `drivers.interfaces.Vehicle` for the promises."""

    def __init__(self, name: str, model: VehicleModel, clock: Clock, setup: VehicleSetup) -> None:
        super().__init__(name)
        self.model = model
        self._clock = clock
        self._setup = setup
        self._odometry = PlanarOdometry(setup.track, setup.count)
        self._velocity = (0.0, 0.0)
        self._renewed = clock.now()
        self._driven = -math.inf
        self._enabled = False
        self._braked: bool | None = None
        self._stopping = 0
        self._count()

    def identity(self) -> Identity:
        """The protocol has no serial number."""
        return Identity(self._setup.make, "", "virtual", "in this process")

    def state(self, max_age: float = 0.2) -> VehicleState:
        """Feedback as the bus carries it, odometry as it is integrated from that."""
        feedback = self.model.feedback(self._clock.now())
        return VehicleState(
            stamp=self._clock.now(), x=self._odometry.x, y=self._odometry.y, yaw=self._odometry.yaw,
            speed=round(feedback.speed, 3), yaw_rate=round(feedback.yaw_rate, 3),
            command_mode=feedback.mode is Mode.CAN, braked=self._braked,
            emergency_stop=feedback.state is ChassisState.EMERGENCY_STOP, error_bits=feedback.errors,
            battery_volts=round(feedback.volts, 1), trouble=system_trouble(feedback.errors, commanded=True),
        )  # fmt: skip

    def check(self) -> None:
        """Raise the `DeviceFault` that the vehicle shows now. Nobody else commands it here."""
        now = self._clock.now()
        feedback = self.model.feedback(now)
        if feedback.state is ChassisState.EMERGENCY_STOP:
            raise vehicle_fault(self.name, "vehicle.emergency_stop")
        if feedback.state is not ChassisState.OK:
            trouble = system_trouble(feedback.errors, commanded=True)
            raise vehicle_error(self.name, feedback.errors, trouble, driven=now - self._driven < REST_AFTER_S)

    def recover(self) -> None:
        """Clear errors and take command, with the brake locked throughout."""
        self._take_command()
        self.brake()

    def enable(self) -> None:
        """Take command and release the brake."""
        self._take_command()
        self.model.set_brake(self._clock.now(), False)
        self._braked = False

    def drive(self, speed: float, yaw_rate: float) -> None:
        """Set the velocity that is kept alive for 0.5 s; `InterlockError` when braked or not enabled."""
        limit, turn = self._setup.max_speed, self._setup.max_yaw_rate
        speed = check_range(self.name, "speed", speed, low=-limit, high=limit, unit="m/s")
        yaw_rate = check_range(self.name, "yaw rate", yaw_rate, low=-turn, high=turn, unit="rad/s")
        self.check()
        if self._stopping:
            raise Aborted(f"{self.name}: a stop is under way")
        if self._braked or not self._enabled:
            reason = "the brake is locked" if self._braked else "it is not under command"
            raise InterlockError(self.name, f"{reason}, so it would not move. Call enable() first")
        self._velocity, self._renewed = (speed, yaw_rate), self._clock.now()
        self._command(self._clock.now())

    def stop(self) -> None:
        """Command zero and wait for standstill."""
        self._velocity = (0.0, 0.0)
        self._stopping += 1
        try:
            self._command(self._clock.now())
            deadline = self._clock.now() + STOP_TIMEOUT_S
            while not self._stands():
                if self._clock.now() > deadline:
                    raise DeadlineError(
                        self.name,
                        f"did not stand still within {STOP_TIMEOUT_S:.0f} s of the stop. Press its emergency stop",
                    )
                self._clock.sleep(KEEP_ALIVE_S)
        finally:
            self._stopping -= 1

    def brake(self) -> None:
        """Stop and lock the brake, also when it does not come to a standstill in time."""
        try:
            self.stop()
        finally:
            self.model.set_brake(self._clock.now(), True)
            self._braked = True

    def close(self) -> None:
        """Stop and brake, unless nobody ever commanded it."""
        if self._enabled:
            self.brake()

    @property
    def tick_s(self) -> float:
        """As often as a driver keeps its command alive, while it drives."""
        return 2.5 * KEEP_ALIVE_S if self._stands() and self._velocity == (0.0, 0.0) else KEEP_ALIVE_S

    def before_tick(self, t: float) -> None:
        """Keep the velocity alive, or let it fall to zero when nobody renews it."""
        if self._clock.now() - self._renewed > DEAD_MAN_S:
            self._velocity = (0.0, 0.0)
        if self._enabled:
            self._command(self._clock.now())

    def after_tick(self, t: float) -> None:
        """Count odometry on."""
        self._count()

    def _take_command(self) -> None:
        now = self._clock.now()
        self.model.clear_errors(now)
        self.model.set_mode(now, Mode.CAN)
        self.check()
        self._velocity, self._enabled = (0.0, 0.0), True

    def _command(self, t: float) -> None:
        speed, yaw_rate = self._velocity
        if self._velocity != (0.0, 0.0):
            self._driven = t
        self.model.command(t, round(speed, 3), round(yaw_rate, 3))

    def _stands(self) -> bool:
        feedback = self.model.feedback(self._clock.now())
        return max(abs(feedback.speed), abs(feedback.yaw_rate)) <= _STILL

    def _count(self) -> None:
        feedback = self.model.feedback(self._clock.now())
        left, right = (round(way / self._setup.count) for way in (feedback.left, feedback.right))
        self._odometry.update(left, right, _FARTHEST_M)
