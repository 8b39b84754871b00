"""Devices whose real counterparts are there: nothing here moves them, they are where they were measured.

Each keeps what it was told by world time. Between two readings a device is taken to go straight; after the newest one
nobody knows, and who wants to know has to wait.
"""

import math
import threading
from collections import deque
from itertools import pairwise

import numpy as np

from sim_backends.models.arm import ArmModel
from sim_backends.models.arm_kinematics import Kinematics, Matrix, Vector
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.models.vehicle import ChassisState, Mode, VehicleModel, VehicleParams, VehicleReadings


class Track:
    """Readings (n,) of one device over the last `keep` world seconds; safe between threads."""

    def __init__(self, keep: float = 15.0) -> None:
        self._keep = keep
        self._rows: deque[tuple[float, Vector]] = deque()
        self._lock = threading.Lock()

    def append(self, t: float, values: Vector) -> bool:
        """Remember a reading; False for one that is not newer than the newest, which is left out."""
        with self._lock:
            if self._rows and t <= self._rows[-1][0]:
                return False
            self._rows.append((t, np.array(values, dtype=np.float64)))
            while self._rows[0][0] < t - self._keep:
                self._rows.popleft()
            return True

    @property
    def until(self) -> float:
        """World time of the newest reading, -inf before the first."""
        with self._lock:
            return self._rows[-1][0] if self._rows else -math.inf

    def at(self, t: float) -> Vector:
        """The values (n,) at world time `t`; the nearest reading's before the first and after the newest. Raises
        LookupError while there is none."""
        (t0, before), (t1, after) = self._around(t)[1:3]
        return before if t1 <= t0 else before + (after - before) * ((t - t0) / (t1 - t0))

    def slope(self, t: float) -> Vector:
        """Change of the values (n,) per second between the readings around `t`; 0 where only one is near."""
        (t0, before), (t1, after) = self._around(t)[1:3]
        return (after - before) / (t1 - t0) if t1 > t0 else np.zeros_like(before)

    def seconds(self, t: float) -> float:
        """Between the two readings around `t`."""
        (t0, _), (t1, _) = self._around(t)[1:3]
        return t1 - t0

    def doubt(self, t: float) -> float:
        """By how much the straight line around `t` may be off, by how its slope differs from its neighbours'. Infinite
        as long as there is no reading after those two."""
        rows = self._around(t)
        (t0, before), (t1, after) = rows[1:3]
        if t1 <= t0 or np.array_equal(before, after):
            return 0.0
        if rows[3][0] <= t1 or rows[0][0] >= t0:
            return math.inf
        slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(rows)]
        bend = max(np.abs(slopes[1] - slopes[0]).max(), np.abs(slopes[2] - slopes[1]).max())
        return float(0.5 * (t1 - t0) * bend)

    def _around(self, t: float) -> list[tuple[float, Vector]]:
        """The two readings around `t`, and on either side another one that is half as far away as those are apart:
        nearer ones would tell of the readings' noise more than of a bend. The outermost again where there is none."""
        with self._lock:
            if not self._rows:
                raise LookupError("nothing was told of this device yet")
            newer: list[tuple[float, Vector]] = []
            # Readers ask for the latest few milliseconds.
            rows = reversed(self._rows)
            before = next(rows)
            while before[0] > t and (older := next(rows, None)) is not None:
                newer.append(before)
                before = older
            after = newer[-1] if newer and before[0] <= t else before
            away = 0.5 * (after[0] - before[0])
            first = next((row for row in rows if row[0] <= before[0] - away), before)
            last = next((row for row in reversed(newer) if row[0] >= after[0] + away), after)
        return [first, before, after, last]


class FollowedArm(ArmModel):
    """The arm at the joint angles that the real one measures, with the table that its controller tells. What that table
    leaves, and the repeatability, are this world's own: nobody can measure those of the real arm."""

    def take_table(self, table: Matrix) -> None:
        """The controller's table (6, 4): a and d in m, alpha and joint offset in rad."""
        with self._lock:
            self.kinematics = Kinematics(table)
            self._truth = self._true_pose(table)
            self._truth.update(self.time, 0.0, self.drive.q, moving=False)

    def follow(self, t: float, joints: Vector, moving: bool) -> Vector:
        """It is at `joints` (6,), rad, at world time `t`. The wrench (6,) on the flange there, in base axes."""
        with self._lock:
            dt = t - self.time
            if dt > 0.0:
                self.drive.qd = (joints - self.drive.q) / dt
                self.drive.q, self.time = joints, t
                self._truth.update(t, min(dt, 1.0), joints, moving)
                self._feel()
            return self.drive.wrench.copy()


class FollowedRail(RailModel):
    """The carriage where the real rail's count puts it, on this world's screw."""

    def __init__(self, params: RailParams, rng: np.random.Generator) -> None:
        super().__init__(params, rng)
        self._nuts = Track()
        self._nut_turns = params.screw.nut(params.start)

    def follow(self, t: float, position: float) -> None:
        """Its motor has turned to `position`, m as the drawn lead counts it, at world time `t`."""
        screw = self.params.screw
        self._nut_turns = screw.follow(self._nut_turns, position / screw.lead)
        self._nuts.append(t, np.array([self._nut_turns]))

    def carriage(self, t: float) -> float:
        """True carriage displacement in m at world time `t`."""
        try:
            return self.params.screw.travel(float(self._nuts.at(t)[0]))
        except LookupError:
            return self.params.start

    def velocity(self, t: float) -> int:
        """Microsteps per second between the readings around `t`."""
        try:
            return round(float(self._nuts.slope(t)[0]) * self._steps())
        except LookupError:
            return 0


class FollowedVehicle(VehicleModel):
    """The vehicle where the real one's odometry puts it, from this world's start on; it leans as this world draws it.
    `shift` (4, 4) moves it as a whole in the world: when somebody has measured where the station stands before it."""

    def __init__(self, params: VehicleParams, rng: np.random.Generator) -> None:
        super().__init__(params, rng)
        self.shift = np.eye(4)
        self._told: tuple[float, float, bool] = (0.0, 0.0, False)
        self._origin: tuple[float, float, float] | None = None

    def follow(self, t: float, x: float, y: float, yaw: float, speed: float, yaw_rate: float, braked: bool) -> None:
        """Odometry in m and rad since any fixed moment, speeds in m/s and rad/s, at world time `t`."""
        tilt = self.sag()
        with self._lock:
            if self._origin is None:
                self._origin = (x, y, yaw)
            x0, y0, yaw0 = self._origin
            ahead = math.cos(yaw0) * (x - x0) + math.sin(yaw0) * (y - y0)
            aside = -math.sin(yaw0) * (x - x0) + math.cos(yaw0) * (y - y0)
            sx, sy, heading = self.params.start
            self._x = sx + math.cos(heading) * ahead - math.sin(heading) * aside
            self._y = sy + math.sin(heading) * ahead + math.cos(heading) * aside
            self._yaw = heading + yaw - yaw0
            self._t, self._tilt, self._told = t, tilt, (speed, yaw_rate, braked)
            self._history.append(t, self._pose())

    def world_from_vehicle(self, t: float) -> Matrix:
        """Pose (4, 4) of the vehicle frame at world time `t`."""
        return np.asarray(self.shift @ self._history.at(t))

    def feedback(self, t: float) -> VehicleReadings:
        """What the real vehicle has told last."""
        speed, yaw_rate, braked = self._told
        return VehicleReadings(
            ChassisState.OK, Mode.CAN, 0, braked=braked, errors=0, volts=self.params.battery_volts, speed=speed,
            yaw_rate=yaw_rate, left=0.0, right=0.0,
        )  # fmt: skip
