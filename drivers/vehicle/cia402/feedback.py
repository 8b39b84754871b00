"""What both drives tell together: the vehicle's state, the faults that it shows, and its metres a second in numbers of
the drives.

Whether a wheel's speed and its counts tell of the same way: a unit may be wrong, in cell.toml or in the drive."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from drivers.clock import Clock, timeout_of
from drivers.errors import DeviceFault
from drivers.interfaces import LinkStatistics, VehicleState
from drivers.vehicle.cia402.drive import OPERATIONAL, STATUS, DriveState, SideDrive, may_turn
from drivers.vehicle.faults import drive_error, two_vehicles, vehicle_fault
from drivers.vehicle.feedback import FAST_AGE_WALL_S, QUIET_S, SILENCE_S, STILL, Feedback, Travel, difference

VelocityUnit = Literal["counts/s", "rpm", "0.1 rpm", "0.01 rpm", "0.001 rpm"]
SIDES = ("left", "right")
SI_UNITS = {
    "counts/s": 0x00B50300, "rpm": 0x00B44700, "0.1 rpm": 0xFFB44700, "0.01 rpm": 0xFEB44700, "0.001 rpm": 0xFDB44700,
}  # fmt: skip
"""How object 60A9h writes these units (CiA 303-2: decimal prefix, numerator, denominator)."""
_RPM = {"rpm": 1.0, "0.1 rpm": 0.1, "0.01 rpm": 0.01, "0.001 rpm": 0.001}


@dataclass(frozen=True)
class WheelDrives:
    """Two wheel drives, left and right, SI units.

    `nodes` are their numbers on the bus. `gear` is turns of the motor per turn of the wheel, `counts` increments per
    turn of the motor, `reversed` whether the motor turns backwards when the vehicle drives ahead. `acceleration` and
    `deceleration` in m/s² are the ramps that the drives keep, `deceleration` also that of halt and quick stop.
    `brake_output` and `stop_input` are bits of a drive's digital outputs and inputs, or None: then the drive switches
    its brake by itself, or nobody tells of the emergency stop. `brake_locks` and `stop_active` are the levels at which
    the brake is locked and the emergency stop is pressed.
    """

    nodes: tuple[int, int]
    wheel_radius: float
    gear: float
    counts: int
    velocity_unit: VelocityUnit
    reversed: tuple[bool, bool]
    track: float
    acceleration: float
    deceleration: float
    brake_output: int | None = None
    brake_locks: bool = False
    stop_input: int | None = None
    stop_active: bool = True

    @property
    def count_length(self) -> float:
        """Way of a wheel's rim per increment, m."""
        return 2.0 * math.pi * self.wheel_radius / (self.gear * self.counts)

    @property
    def velocity_step(self) -> float:
        """Speed of a wheel's rim per unit of velocity, m/s."""
        turn = 2.0 * math.pi * self.wheel_radius / self.gear
        return turn / self.counts if self.velocity_unit == "counts/s" else _RPM[self.velocity_unit] * turn / 60.0

    def targets(self, speed: float, yaw_rate: float) -> tuple[int, int]:
        """Target velocities of both drives for m/s and rad/s of the vehicle."""
        rims = speed - 0.5 * self.track * yaw_rate, speed + 0.5 * self.track * yaw_rate
        left, right = (
            round(rim / self.velocity_step) * (-1 if back else 1) for rim, back in zip(rims, self.reversed, strict=True)
        )
        return left, right

    def motion(self, velocities: tuple[int, int]) -> tuple[float, float]:
        """Speed in m/s and yaw rate in rad/s of the vehicle from what both drives report."""
        left, right = (
            velocity * self.velocity_step * (-1 if back else 1)
            for velocity, back in zip(velocities, self.reversed, strict=True)
        )
        return 0.5 * (left + right), (right - left) / self.track

    def ramp(self, acceleration: float) -> int:
        """m/s² of the rim as the drives have it: units of velocity per second."""
        return max(1, round(acceleration / self.velocity_step))


WAY_M, WALL_S = 0.05, 0.3
"""Over which both are compared, at least: m, and seconds on the wall."""
GAP_WALL_S = 0.1
"""A reading that comes later than this after the last, on the wall, does not say how it went between."""
RATIO = 1.6
"""By which both may differ. Readings that bunch up make a third."""
IN_A_ROW = 2
CREEPS = 0.02
"""Below this, m/s, nothing is compared: an offset of a drive's speed must not add up."""


class UnitCheck:
    """One wheel."""

    def __init__(self, clock: Clock, wheels: WheelDrives) -> None:
        self._clock = clock
        self._count, self._step = wheels.count_length, wheels.velocity_step
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._last: tuple[float, int, int] | None = None
        self._wrong = 0
        self._begin()

    def _begin(self) -> None:
        self._counted = self._told = self._took = 0.0

    def contradiction(self, now: float, position: int, velocity: int) -> float:
        """Take a reading; the ratio of both ways, speed's to counts', where it is wrong in every comparison, else 0."""
        last, self._last = self._last, (now, position, velocity)
        if last is None:
            return 0.0
        took = now - last[0]
        turned = difference(position, last[1]) * self._count
        stands = abs(velocity) * self._step < CREEPS and abs(turned) < CREEPS * took
        if stands or self._clock.wall(took) > GAP_WALL_S:
            self._begin()
            return 0.0
        self._counted += turned
        self._told += 0.5 * (velocity + last[2]) * self._step * took
        self._took += took
        if self._clock.wall(self._took) < WALL_S or max(abs(self._counted), abs(self._told)) < WAY_M:
            return 0.0
        ratio = self._told / self._counted if self._counted else math.inf
        self._begin()
        self._wrong = 0 if 1.0 / RATIO < ratio < RATIO else self._wrong + 1
        return ratio if self._wrong >= IN_A_ROW else 0.0


UNHEARD = 8
"""A drive that drives and was asked so many times for its state without an answer is lost."""
CREPT_M = 0.001
"""What a wheel may go on by its counts while its speed says standstill: a rotor hunts by some of them."""
AT_REST = 3
"""So many pairs of readings in a row have to say standstill: a speed alone may come from a drive that tells none."""
_RELEASED_WALL_S = 0.3
_PAIR_WALL_S = 0.006
"""Both drives answer one SYNC within this; the next comes after 10 ms at the earliest."""


class DriveFeedback(Feedback):
    """Both drives and the way of their wheels; `take` is called by the receive thread."""

    def __init__(
        self, name: str, clock: Clock, wheels: WheelDrives, *, max_speed: float, max_yaw_rate: float,
        statistics: LinkStatistics,
    ) -> None:  # fmt: skip
        self._wheels = wheels
        self._statistics = statistics
        self.drives = tuple(SideDrive(side, node) for side, node in zip(SIDES, wheels.nodes, strict=True))
        self._by_node = {drive.node: drive for drive in self.drives}
        travel = Travel(
            clock, statistics, track=wheels.track, max_speed=max_speed, max_yaw_rate=max_yaw_rate,
            unit=wheels.count_length,
        )  # fmt: skip
        super().__init__(name, clock, travel)
        self._single: tuple[int, float] | None = None
        self._units = [UnitCheck(clock, wheels), UnitCheck(clock, wheels)]
        self._rests_at: tuple[int, ...] = ()
        self._rested = 0
        self.mismatch = ""
        """How a wheel's speed and its counts contradict each other."""
        self.proving = False
        """The drives' watchdog is being tried: that it stops them is no fault."""

    def take(self, node: int, service: int, data: bytes, in_pdo: bool = True) -> None:
        """Take a drive's frame, or what it was asked for one by one. Raises ValueError for one of another length."""
        now = self._clock.now()
        with self._news:
            drive = self._by_node[node]
            if drive.quiet > QUIET_S:
                self._travel.interrupt(f"nothing was heard of the {drive.side} drive for {drive.quiet:.1f} s")
            if drive.take(service, data, now):
                self._travel.interrupt(f"the {drive.side} drive was restarted")
            if service == STATUS and in_pdo and self._is_pair(node, now):
                self._count(now)
            self._news.notify_all()

    def _is_pair(self, node: int, now: float) -> bool:
        """Whether both drives have told of the same SYNC: a reading of one side alone would be half a turn."""
        other, self._single = self._single, (node, now)
        if other is None or other[0] == node or self._clock.wall(now - other[1]) > _PAIR_WALL_S:
            return False
        self._single = None
        return True

    def _count(self, now: float) -> None:
        left, right = (
            -drive.position if back else drive.position
            for drive, back in zip(self.drives, self._wheels.reversed, strict=True)
        )
        self._travel.count(now, left, right)
        self._compare_rest()
        for drive, units in zip(self.drives, self._units, strict=True):
            if math.isfinite(drive.moved) and (ratio := units.contradiction(now, drive.position, drive.velocity)):
                self.mismatch = (
                    f"the {drive.side} wheel's speed is {ratio:.3g} times what its counts say: vehicle.velocity_unit "
                    f'"{self._wheels.velocity_unit}" and vehicle.counts_per_turn {self._wheels.counts} do not fit its '
                    "drive"
                )

    def _compare_rest(self) -> None:
        """How many pairs in a row the counts have stayed where they are."""
        counts = tuple(drive.position for drive in self.drives)
        moved = [abs(difference(now, then)) for now, then in zip(counts, self._rests_at, strict=False)]
        if not moved or max(moved) * self._wheels.count_length > CREPT_M:
            self._rests_at, self._rested = counts, 0
        self._rested += 1

    def other(self, what: str) -> None:
        """Somebody else commands."""
        with self._news:
            self._travel.disturb(what)
            self._statistics.count("other_master")
            self._news.notify_all()

    def idle(self, seconds: float) -> None:
        """The receiver has waited for `seconds` on the wall."""
        with self._news:
            for drive in self.drives:
                drive.quiet += seconds
                for service in drive.untold:
                    drive.untold[service] += seconds

    def asked(self) -> None:
        """The drives were just asked to tell their state."""
        with self._news:
            for drive in self.drives:
                drive.waited += 1

    def acknowledge(self) -> None:
        """Whoever takes command now has heard of what was before."""
        with self._news:
            super().acknowledge()
            self.mismatch = ""
            for drive, units in zip(self.drives, self._units, strict=True):
                drive.waited = 0
                units.forget()

    @property
    def disturbance(self) -> str:
        """How somebody else commands or moves the vehicle."""
        with self._news:
            return self._travel.disturbance

    def complete(self) -> bool:
        """True once both drives have told status and motion."""
        return all(math.isfinite(min(drive.told, drive.moved)) for drive in self.drives)

    def newer(self, time: float) -> bool:
        """True when both drives have told status and motion after host time `time`."""
        return all(min(drive.told, drive.moved) > time for drive in self.drives)

    def operational(self) -> bool:
        """Whether both drives are, as far as they have told."""
        return all(drive.nmt in (None, OPERATIONAL) for drive in self.drives)

    def all_in(self, *states: DriveState) -> bool:
        """Whether both drives are in one of these states."""
        return all(drive.state in states for drive in self.drives)

    def statuswords_other_than(self, seen: tuple[int, ...]) -> bool:
        """Whether a drive has told another statusword than `seen`."""
        return tuple(drive.statusword for drive in self.drives) != seen

    def all_but(self, which: Callable[[DriveState], bool]) -> bool:
        """Whether no drive is in a state of which `which` is true."""
        return not any(which(drive.state) for drive in self.drives)

    def may_turn(self) -> bool:
        """Whether a drive may turn its wheel, so that its own brake is open."""
        return any(may_turn(drive.state) for drive in self.drives)

    def stands(self, since: float) -> bool:
        """True when both drives have reported standstill after host time `since`, and their counts do not deny it."""
        if self._travel.swings() or self._rested < AT_REST:
            return False
        slow = max(STILL, 1.5 * self._wheels.velocity_step)
        at_rest = all(abs(drive.velocity) * self._wheels.velocity_step <= slow for drive in self.drives)
        return at_rest and all(drive.moved > since for drive in self.drives)

    def gave_up(self) -> DeviceFault | None:
        """Why the vehicle, enabled, must not drive on; None when both drives obey. One wheel alone never drives."""
        with self._news:
            if found := self._reported():
                return found
            for drive in self.drives:
                if drive.waited > UNHEARD and self._clock.wall(self._clock.now() - drive.told) > FAST_AGE_WALL_S:
                    return vehicle_fault(
                        self._name, "vehicle.silent", f"the {drive.side} drive does not tell its state any more"
                    )
                if why := drive.left_command():
                    hint = "See why, look where the vehicle stands, then run the job again."
                    return vehicle_fault(self._name, "vehicle.command_lost", why, hint)
            return self._contradicted()

    def _reported(self) -> DeviceFault | None:
        """Feedback of two vehicles, an emergency stop, or a drive's fault."""
        if what := self._travel.two_vehicles:
            return two_vehicles(self._name, what)
        if self._stopped():
            return vehicle_fault(self._name, "vehicle.emergency_stop")
        trouble = self._trouble()
        return drive_error(self._name, "; ".join(trouble), driven=self._travel.driven) if trouble else None

    def _trouble(self) -> tuple[str, ...]:
        return () if self.proving else tuple(word for drive in self.drives for word in drive.trouble())

    def _contradicted(self) -> DeviceFault | None:
        """What a vehicle that obeys must not show: another master, or units that do not fit."""
        if self.mismatch:
            return vehicle_fault(self._name, "vehicle.units", self.mismatch)
        disturbance = self._travel.disturbance
        return vehicle_fault(self._name, "vehicle.disturbed", disturbance) if disturbance else None

    def require_released(self) -> None:
        """Raise the `DeviceFault` of an emergency stop that is pressed; one that was just released is waited for."""
        if not self.wait_for(lambda: not self._stopped(), 0.0, lambda: True, _RELEASED_WALL_S):
            raise vehicle_fault(self._name, "vehicle.emergency_stop")

    def _stopped(self) -> bool:
        """Whether a drive's input says that the emergency stop is pressed."""
        bit = self._wheels.stop_input
        if bit is None:
            return False
        return any((drive.inputs >> bit & 1 == 1) == self._wheels.stop_active for drive in self.drives)

    def state(self, max_age: float, braked: bool | None, in_command: bool) -> VehicleState:
        """All as one record; `DeadlineError` when it is older than `max_age` s."""
        with self._news:
            told = min(min(drive.told, drive.moved) for drive in self.drives)
            left, right = self.drives
            speed, yaw_rate = self._wheels.motion((left.velocity, right.velocity))
            odometry, travel = self._travel.odometry, self._travel
            volts = [drive.millivolts for drive in self.drives if drive.millivolts is not None]
            found = VehicleState(
                stamp=told, x=odometry.x, y=odometry.y, yaw=odometry.yaw, speed=speed, yaw_rate=yaw_rate,
                command_mode=in_command and not any(drive.left_command() for drive in self.drives), braked=braked,
                emergency_stop=self._stopped(), error_bits=max(drive.code for drive in self.drives),
                battery_volts=round(1e-3 * min(volts), 1) if volts else None, trouble=self._trouble(),
                warnings=tuple(word for drive in self.drives for word in drive.warnings()),
                interruptions=travel.interruptions, interruption=travel.interruption,
            )  # fmt: skip
        self._require_young(told, max_age)
        return found

    def check(self, *, in_command: bool, driving: bool, lost: DeviceFault | None = None) -> None:
        """Raise the `DeviceFault` that the drives show; `lost` is why this program lost command, if it did.

        One who is `driving` must have heard of both lately. For a vehicle that stands it is enough that the receiver
        does not wait in vain: a program that computes reads late.
        """
        with self._news:
            late = min(self.drives, key=lambda drive: min(drive.told, drive.moved))
            silent = self._clock.now() - min(late.told, late.moved)
            untold, side = max((max(drive.untold.values()), drive.side) for drive in self.drives)
            reported, contradicted = self._reported(), self._contradicted()
        if untold > QUIET_S:
            raise vehicle_fault(
                self._name, "vehicle.silent", f"the {side} drive does not tell its state, for {untold:.2f} s"
            )
        if driving and silent > timeout_of(self._clock, SILENCE_S):
            raise vehicle_fault(
                self._name, "vehicle.silent", f"no feedback of the {late.side} drive for {silent:.2f} s"
            )
        if reported is not None:
            raise reported
        if in_command and contradicted is not None:
            raise contradicted
        if in_command and lost is not None:
            self.interrupt(lost.message)
            raise lost
