"""Along a line and on the spot the vehicle comes to rest where it was sent, on odometry, also with late feedback."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.devices.simulated.direct import VirtualCell
from cell.procedures.drive.driving import Planar, RelativeOdometry, drive_line, line_command, turn_to, wrap
from drivers.errors import DeviceFault
from drivers.interfaces import VehicleState


def test_planar_poses_are_a_group():
    a, b = Planar(1.0, -2.0, 0.7), Planar(-0.3, 0.4, 2.9)
    identity = a * a.inverse()
    assert (identity.x, identity.y, identity.yaw) == pytest.approx((0, 0, 0), abs=1e-12)
    left, right = (a * b).inverse(), b.inverse() * a.inverse()
    assert (left.x, left.y, left.yaw) == pytest.approx((right.x, right.y, right.yaw), abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 3.0, -3.0, 7.0, -7.0, 100.0])
def test_wrapped_angles_are_the_same_direction(angle: float):
    assert abs(wrap(angle)) <= math.pi
    assert math.cos(wrap(angle)) == pytest.approx(math.cos(angle))


@pytest.mark.parametrize("seed", range(20))
def test_the_line_law_arrives_within_a_centimetre_and_a_degree(seed: int):
    """A vehicle with limited acceleration, controlled at 25 Hz, from up to 40 mm and 2° beside an 0.8 m line."""
    rng = np.random.default_rng(seed)
    pose = Planar(-0.8, rng.uniform(-0.04, 0.04), math.radians(rng.uniform(-2, 2)))
    goal, speed, rate, command, step = Planar(0.0, 0.0, 0.0), 0.0, 0.0, (0.0, 0.0), 0.01
    for tick in range(3000):
        if tick % 4 == 0:
            command = line_command(pose, goal, 0.4)
            if command[0] <= 0:
                break
        speed += np.clip(command[0] - speed, -0.5 * step, 0.5 * step)
        rate += np.clip(command[1] - rate, -1.5 * step, 1.5 * step)
        pose = pose * Planar(speed * step, 0.0, rate * step)
    assert abs(pose.x) < 0.002 and abs(pose.y) < 0.010 and abs(pose.yaw) < math.radians(2.0)
    assert speed < 0.05


def test_backwards_the_law_steers_the_other_way():
    ahead = line_command(Planar(-0.5, 0.02, 0.0), Planar(0, 0, 0), 0.3)
    behind = line_command(Planar(0.5, 0.02, 0.0), Planar(0, 0, 0), 0.3)
    assert ahead[0] > 0 > behind[0]
    assert ahead[1] < 0 < behind[1]


# --- driving on odometry, with the simulated vehicle ---


@pytest.fixture
def cell() -> VirtualCell:
    made = VirtualCell(load_config(None), 2)
    made.vehicle.enable()
    return made


def speed(cell: VirtualCell) -> float:
    """True, the larger of m/s and rad/s."""
    told = cell.world.vehicle.feedback(cell.clock.now())
    return max(abs(told.speed), abs(told.yaw_rate))


def truth(cell: VirtualCell) -> Planar:
    """Where the vehicle truly stands in the world."""
    return Planar(*cell.world.vehicle.planar(cell.clock.now()))


def moved(before: Planar, after: Planar) -> float:
    return math.hypot(after.x - before.x, after.y - before.y)


def straight(goal: float, cell: VirtualCell, odometry: object, check: object) -> None:
    drive_line(cell.vehicle, odometry, Planar(goal, 0.0, 0.0), 0.3, cell.clock, check)  # type: ignore[arg-type]


def round_about(cell: VirtualCell, odometry: object, check: object) -> None:
    turn_to(cell.vehicle, odometry, 0.2, cell.clock, check)  # type: ignore[arg-type]


WAYS = [partial(straight, 0.3), partial(straight, -0.1), round_about]


@pytest.mark.parametrize("way", WAYS)
def test_at_the_end_of_a_way_it_stands(cell: VirtualCell, way):
    way(cell, RelativeOdometry(cell.vehicle), lambda: None)
    assert speed(cell) == pytest.approx(0.0, abs=1e-3)


def test_what_does_not_come_along_is_given_up_and_left_for_a_person(cell: VirtualCell):
    begun = cell.clock.now()
    with pytest.raises(DeviceFault, match="in time") as caught:
        # Odometry of wheels that do not come along.
        round_about(cell, SimpleNamespace(pose=lambda: Planar(0.0, 0.0, 0.0)), lambda: None)
    assert (caught.value.code, caught.value.recoverable) == ("vehicle.blocked", False)
    assert speed(cell) == pytest.approx(0.0, abs=1e-3)
    assert cell.clock.now() - begun < 45.0


class Enough(Exception):
    pass


@pytest.mark.parametrize("way", WAYS)
def test_who_wants_the_end_of_a_way_is_asked_all_along(cell: VirtualCell, way):
    wanted = cell.clock.now() + 0.4

    def check() -> None:
        if cell.clock.now() > wanted:
            raise Enough

    with pytest.raises(Enough):
        way(cell, RelativeOdometry(cell.vehicle), check)
    assert cell.clock.now() - wanted < 0.1


class LateVehicle:
    """The simulated vehicle behind a bus that once, at the end of its way unseen, hands on nothing new for a while.
    With `looks_new` what it hands on is old, but seems to be of now, as from an adapter that holds it back."""

    def __init__(self, cell: VirtualCell, begins: float, lasts: float, looks_new: bool) -> None:
        self._looks_new = looks_new
        self._vehicle, self._clock = cell.vehicle, cell.clock
        self._begins, self._until, self._lasts = begins, math.inf, lasts
        self._old: VehicleState | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._vehicle, name)

    def state(self, max_age: float = 0.2) -> VehicleState:
        if self._old is None and self._vehicle.state().x >= self._begins:
            self._old, self._until = self._vehicle.state(), self._clock.now() + self._lasts
        if self._old is not None and self._clock.now() < self._until:
            return replace(self._old, stamp=self._clock.now()) if self._looks_new else self._old
        state: VehicleState = self._vehicle.state()
        return state


@pytest.mark.parametrize("seed", [2, 5])
def test_a_vehicle_stands_where_it_may_have_arrived_until_newer_feedback_tells(seed: int):
    cell = VirtualCell(load_config(None), seed)
    vehicle = LateVehicle(cell, 0.45, 0.6, looks_new=False)
    cell.vehicle.enable()
    begun, furthest = truth(cell), 0.0

    def look() -> None:
        nonlocal furthest
        furthest = max(furthest, moved(begun, truth(cell)))

    drive_line(vehicle, RelativeOdometry(vehicle), Planar(0.5, 0.0, 0.0), 0.4, cell.clock, look)
    assert furthest < 0.52, "0.4 m/s for 0.6 s would be 0.24 m"
    assert moved(begun, truth(cell)) == pytest.approx(0.5, abs=0.02), "news come, and it goes the rest"
    vehicle = LateVehicle(cell, -1.0, 0.6, looks_new=False)
    odometry = RelativeOdometry(vehicle)
    heading = truth(cell).yaw
    turn_to(vehicle, odometry, 0.1, cell.clock, look)
    assert wrap(truth(cell).yaw - heading) == pytest.approx(0.1, abs=0.01)
