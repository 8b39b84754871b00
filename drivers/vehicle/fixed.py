"""No vehicle at all: the arm stands on a frame that is bolted down, and stations are brought to it.

It stands and is braked, always; whoever wants to drive it is told that there is nothing to drive.
"""

from drivers.clock import Clock
from drivers.errors import InterlockError, NotConnectedError
from drivers.interfaces import Identity, LinkStatistics, VehicleState


class FixedVehicle:
    """A vehicle that is none; see `drivers.interfaces.Vehicle`. Odometry stays at 0; there is no battery."""

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self._clock = clock
        self._closed = False

    def identity(self) -> Identity:
        """That there is none."""
        self._require_open()
        return Identity("no vehicle, a fixed frame", "", "none", "fixed")

    def ping(self) -> float:
        """Nothing is asked over any wire: 0 s."""
        self._require_open()
        return 0.0

    def state(self, max_age: float = 0.2) -> VehicleState:
        """At rest, braked and in command, as of now."""
        self._require_open()
        return VehicleState(
            stamp=self._clock.now(), x=0.0, y=0.0, yaw=0.0, speed=0.0, yaw_rate=0.0, command_mode=True, braked=True,
            emergency_stop=False, error_bits=0, battery_volts=None,
        )  # fmt: skip

    def check(self) -> None:
        """It has no faults."""
        self._require_open()

    def enable(self) -> None:
        """Nothing to enable."""
        self._require_open()

    def recover(self) -> None:
        """Nothing to recover."""
        self._require_open()

    def drive(self, speed: float, yaw_rate: float) -> None:
        """`InterlockError`, unless it is to stand."""
        self._require_open()
        if speed != 0.0 or yaw_rate != 0.0:
            raise InterlockError(
                self.name,
                'cannot drive: vehicle.driver = "fixed" says that the arm stands on a fixed frame. Bring the station '
                "to it, or name the vehicle's make",
            )

    def stop(self) -> None:
        """It stands."""

    def brake(self) -> None:
        """It is braked."""
        self._require_open()

    def close(self) -> None:
        """Every later call but `stop` and `close` raises `NotConnectedError`."""
        self._closed = True

    def _require_open(self) -> None:
        if self._closed:
            raise NotConnectedError(self.name, "was closed. Open it again")
