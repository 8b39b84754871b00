"""The way to the target: planar poses form a group, and the line law brings the vehicle in from beside the line."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.devices.simulated.direct import VirtualCell
from cell.procedures.drive.approach import Planar, RelativeOdometry, drive_line, line_command, turn_to, wrap
from drivers.errors import DeviceFault


def test_planar_poses_are_a_group() -> None:
    a, b = Planar(1.0, -2.0, 0.7), Planar(-0.3, 0.4, 2.9)
    identity = a * a.inverse()
    assert (identity.x, identity.y, identity.yaw) == pytest.approx((0, 0, 0), abs=1e-12)
    left, right = (a * b).inverse(), b.inverse() * a.inverse()
    assert (left.x, left.y, left.yaw) == pytest.approx((right.x, right.y, right.yaw), abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 3.0, -3.0, 7.0, -7.0, 100.0])
def test_wrapped_angles_are_the_same_direction(angle: float) -> None:
    assert abs(wrap(angle)) <= math.pi
    assert math.cos(wrap(angle)) == pytest.approx(math.cos(angle))


@pytest.mark.parametrize("seed", range(20))
def test_the_line_law_arrives_within_a_centimetre_and_a_degree(seed: int) -> None:
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
    assert abs(pose.x) < 0.002
    assert abs(pose.y) < 0.010
    assert abs(pose.yaw) < math.radians(2.0)
    assert speed < 0.05


def test_backwards_the_law_steers_the_other_way() -> None:
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


class Blocked:
    """Odometry of wheels that do not come along."""

    def pose(self) -> Planar:
        return Planar(0.0, 0.0, 0.0)


def speed(cell: VirtualCell) -> float:
    """True, the larger of m/s and rad/s."""
    told = cell.world.vehicle.feedback(cell.clock.now())
    return max(abs(told.speed), abs(told.yaw_rate))


def ahead(cell: VirtualCell, odometry: object, check: object) -> None:
    drive_line(cell.vehicle, odometry, Planar(0.3, 0.0, 0.0), 0.3, cell.clock, check)  # type: ignore[arg-type]


def back(cell: VirtualCell, odometry: object, check: object) -> None:
    drive_line(cell.vehicle, odometry, Planar(-0.1, 0.0, 0.0), 0.3, cell.clock, check)  # type: ignore[arg-type]


def round_about(cell: VirtualCell, odometry: object, check: object) -> None:
    turn_to(cell.vehicle, odometry, 0.2, cell.clock, check)  # type: ignore[arg-type]


@pytest.mark.parametrize("way", [ahead, back, round_about])
def test_at_the_end_of_a_way_it_stands(cell: VirtualCell, way) -> None:
    way(cell, RelativeOdometry(cell.vehicle), lambda: None)
    assert speed(cell) == pytest.approx(0.0, abs=1e-3)


def test_what_does_not_come_along_is_given_up_and_left_for_a_person(cell: VirtualCell) -> None:
    begun = cell.clock.now()
    with pytest.raises(DeviceFault, match="in time") as caught:
        round_about(cell, Blocked(), lambda: None)
    assert (caught.value.code, caught.value.recoverable) == ("vehicle.blocked", False)
    assert speed(cell) == pytest.approx(0.0, abs=1e-3)
    assert cell.clock.now() - begun < 45.0


class Enough(Exception):
    pass


@pytest.mark.parametrize("way", [ahead, back, round_about])
def test_who_wants_the_end_of_a_way_is_asked_all_along(cell: VirtualCell, way) -> None:
    wanted = cell.clock.now() + 0.4

    def check() -> None:
        if cell.clock.now() > wanted:
            raise Enough

    with pytest.raises(Enough):
        way(cell, RelativeOdometry(cell.vehicle), check)
    assert cell.clock.now() - wanted < 0.1
