"""The simulated vehicle in lock step: commands and odometry in the steps of 1 mm and 1 mrad/s that its bus carries."""

from __future__ import annotations

from cell.config import VehicleConfig
from drivers.clock import Clock
from drivers.errors import DeadlineError, InterlockError
from drivers.interfaces import Identity, LinkStatistics, VehicleState
from drivers.quantities import check_range
from drivers.vehicle.agilex import DEAD_MAN_S, KEEP_ALIVE_S, STOP_TIMEOUT_S
from drivers.vehicle.faults import system_trouble, vehicle_error
from drivers.vehicle.odometry import PlanarOdometry
from sim_backends.models.vehicle import Mode, State, VehicleModel

_STILL = 0.002
_FARTHEST_M = 0.5


class LockstepVehicle:
    """The vehicle `model`; see `drivers.interfaces.Vehicle` for the promises."""

    def __init__(self, name: str, model: VehicleModel, clock: Clock, config: VehicleConfig) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self.model = model
        self._clock = clock
        self._config = config
        self._odometry = PlanarOdometry(config.track)
        self._velocity = (0.0, 0.0)
        self._renewed = clock.now()
        self._enabled = False
        self._count()

    def identity(self) -> Identity:
        """The protocol has no serial number."""
        return Identity("AgileX v2", "", "lock step", "in this process")

    def ping(self) -> float:
        """No wire: 0 s."""
        return 0.0

    def state(self, max_age: float = 0.2) -> VehicleState:
        """Feedback as the bus carries it, odometry as the driver integrates it."""
        feedback = self.model.feedback(self._clock.now())
        return VehicleState(
            stamp=self._clock.now(),
            x=self._odometry.x,
            y=self._odometry.y,
            yaw=self._odometry.yaw,
            speed=round(feedback.speed, 3),
            yaw_rate=round(feedback.yaw_rate, 3),
            command_mode=feedback.mode is Mode.CAN,
            braked=feedback.braked,
            emergency_stop=feedback.state is State.EMERGENCY_STOP,
            error_bits=feedback.errors,
            battery_volts=round(feedback.volts, 1),
            trouble=system_trouble(feedback.errors, commanded=True),
        )

    def check(self) -> None:
        """Nobody causes faults here but a collision, whose error bits tell."""
        feedback = self.model.feedback(self._clock.now())
        if feedback.state is not State.OK:
            raise vehicle_error(
                self.name, feedback.errors, system_trouble(feedback.errors, commanded=True), driven=True
            )

    def recover(self) -> None:
        """Clear errors and take command, braked."""
        now = self._clock.now()
        self.model.clear_errors(now)
        self.model.set_mode(now, Mode.CAN)
        self._enabled = True
        self.brake()

    def enable(self) -> None:
        """Take command and release the brake."""
        now = self._clock.now()
        self.model.clear_errors(now)
        self.model.set_mode(now, Mode.CAN)
        self.model.set_brake(now, False)
        self._velocity, self._enabled = (0.0, 0.0), True

    def drive(self, speed: float, yaw_rate: float) -> None:
        """Set the velocity that is kept alive for 0.5 s; `InterlockError` when braked or not enabled."""
        self.check()
        limit, turn = self._config.max_speed, self._config.max_yaw_rate
        speed = check_range(self.name, "speed", speed, -limit, limit, "m/s")
        yaw_rate = check_range(self.name, "yaw rate", yaw_rate, -turn, turn, "rad/s")
        if not self._enabled or self.model.feedback(self._clock.now()).braked:
            raise InterlockError(self.name, "is braked or not under command. Call enable() first")
        self._velocity, self._renewed = (speed, yaw_rate), self._clock.now()
        self._command(self._clock.now())

    def stop(self) -> None:
        """Command zero and wait for standstill."""
        self._velocity = (0.0, 0.0)
        self._command(self._clock.now())
        deadline = self._clock.now() + STOP_TIMEOUT_S
        while not self._stands():
            if self._clock.now() > deadline:
                raise DeadlineError(self.name, f"did not stand still within {STOP_TIMEOUT_S:g} s")
            self._clock.sleep(KEEP_ALIVE_S)

    def brake(self) -> None:
        """Stop and lock the brake."""
        self.stop()
        self.model.set_brake(self._clock.now(), True)

    def close(self) -> None:
        """Stop."""
        self.stop()

    # --- ticking ---

    @property
    def tick_s(self) -> float:
        """As often as the driver keeps its command alive, while it drives."""
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

    def _command(self, t: float) -> None:
        speed, yaw_rate = self._velocity
        self.model.command(t, round(speed, 3), round(yaw_rate, 3))

    def _stands(self) -> bool:
        feedback = self.model.feedback(self._clock.now())
        return max(abs(feedback.speed), abs(feedback.yaw_rate)) <= _STILL

    def _count(self) -> None:
        feedback = self.model.feedback(self._clock.now())
        self._odometry.update(round(1e3 * feedback.left), round(1e3 * feedback.right), _FARTHEST_M)
