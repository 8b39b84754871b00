"""The world after real devices: a picture is of where they were, or there is none."""

import numpy as np
import pytest

from sim_backends.clock import SteppedClock
from sim_backends.models.arm_motion import JointMove
from sim_backends.models.vehicle import Mode
from sim_backends.world.drawing import inverse
from sim_backends.world.following import NotFollowed, WorldFollowing
from sim_backends.world.world import World
from tests.support import ROOT

EVERYTHING = ("arm", "rail", "vehicle")


@pytest.fixture(scope="module")
def pair() -> tuple[World, World, WorldFollowing]:
    """A world that stands in for the hardware, and one of the same drawing without deviations that follows it."""
    clock = SteppedClock()
    real = World(11, "ideal", clock=clock)
    follower = World(3, "ideal", clock=clock, followed=EVERYTHING)
    return real, follower, WorldFollowing(follower, EVERYTHING)


def _odometry(x: float, y: float, yaw: float) -> tuple[float, float, float]:
    """The same in a frame of its own: odometry counts from wherever it was switched on."""
    return float(np.cos(0.7) * x - np.sin(0.7) * y + 5.0), float(np.sin(0.7) * x + np.cos(0.7) * y - 2.0), yaw + 0.7


def _drive(real: World, told: WorldFollowing, seconds: float) -> None:
    """The stand-in's arm, rail and vehicle all move; what each measures of itself is told at its own pace."""
    clock, begun = real.clock, real.clock.now()
    start = real.rail.carriage(begun)
    real.vehicle.set_mode(begun, Mode.CAN)
    real.rail.move_to(begun, -60_000)
    for k in range(round(seconds / 0.002) + 1):
        t = begun + 0.002 * k
        clock.step_to(t)
        if k == 0:
            real.arm.start(JointMove(real.arm.drive.q + 0.1, 0.5, 1.4))
        real.arm.tick(t)
        real.vehicle.command(t, 0.2, 0.1)
        real.vehicle.tick(t)
        if k % 2 == 0:
            told.tell("arm", [[t, *real.arm.drive.q, float(real.arm.moving), float(real.arm.digital_outputs)]])
        if k % 5 == 0:
            turns = real.rail.position(t) / (200 << real.rail.settings.microsteps)
            told.tell("rail", [[t, start + turns * 0.002]])
        if k % 10 == 0:
            state = real.vehicle.feedback(t)
            told.tell("vehicle", [[t, *_odometry(*real.vehicle.planar(t)), state.speed, state.yaw_rate, 0.0]])


def test_the_world_stands_as_what_it_follows(pair: tuple[World, World, WorldFollowing]):
    real, follower, told = pair
    told.begin_arm(None, 0)
    _drive(real, told, 1.0)
    for t in np.linspace(0.3, 0.98, 7):
        told.require("scan", t)
        ours, theirs = follower.world_from_flange(t), real.world_from_flange(t)
        assert np.abs(ours[:3, 3] - theirs[:3, 3]).max() < 2e-4
        assert np.abs(ours[:3, :3] - theirs[:3, :3]).max() < 2e-4
        assert follower.rail.carriage(t) == pytest.approx(real.rail.carriage(t), abs=1e-5)
    assert abs(real.rail.carriage(1.0) - real.rail.carriage(0.0)) > 1e-3
    assert np.abs(real.world_from_flange(0.98)[:3, 3] - real.world_from_flange(0.3)[:3, 3]).max() > 0.05
    assert told.figures()["devices"]["rail"]["readings"] > 50


def test_of_a_moment_that_nobody_told_of_there_is_no_picture(pair: tuple[World, World, WorldFollowing], monkeypatch):
    told = pair[2]
    monkeypatch.setattr("sim_backends.world.following.LONGEST_WAIT_S", 0.05)
    with pytest.raises(NotFollowed, match=r"no reading of the arm came within 0\.05 s"):
        told.require("target", 7.0)
    assert told.figures()["not_made"] >= 1


def test_in_a_gap_in_which_something_moved_there_is_no_picture(pair: tuple[World, World, WorldFollowing]):
    """The arm turned by 0.3 rad between two readings that are 0.2 s apart, and stood before and after."""
    real, _, told = pair
    t = max(0.0, told._tracks["arm"].until)
    told.tell("vehicle", [[t + at, 0.2, 0.0, 0.0, 0.0, 0.0, 1.0] for at in (0.1, 3.0)])
    for at, turned in ((0.5, 0.0), (0.7, 0.0), (0.9, 0.3), (1.1, 0.3)):
        told.tell("arm", [[t + at, *(real.arm.drive.q + turned), 0.0, 0.0]])
    told.require("target", t + 0.6)
    told.require("target", t + 1.0)
    with pytest.raises(NotFollowed, match="where the arm was is not known: two readings of it are 200 ms apart"):
        told.require("target", t + 0.8)


def test_how_late_the_readings_came_is_told_as_it_is_documented(pair: tuple[World, World, WorldFollowing]):
    figures = pair[2].figures()
    told = {f"following.{key}" for key in figures} | {f"following.devices.*.{key}" for key in figures["devices"]["arm"]}
    text = (ROOT / "docs" / "reference" / "report.md").read_text(encoding="utf-8")
    assert {key for key in told - {"following.devices"} if f"`{key}" not in text} == set()
    assert set(figures["devices"]["arm"]["latency_ms"]) == {"p50", "p99", "most"}


def test_a_camera_that_does_not_ride_on_the_rail_does_not_wait_for_it(pair: tuple[World, World, WorldFollowing]):
    real, follower, told = pair
    t = told._tracks["arm"].until + 0.5
    told.tell("arm", [[t, *real.arm.drive.q, 0.0, 0.0]])
    told.tell("vehicle", [[t, 0.2, 0.0, 0.0, 0.0, 0.0, 1.0]])
    assert follower.rail.carriage(t) == follower.rail.carriage(t - 0.4)


def test_a_measured_board_brings_the_world_to_the_station(pair: tuple[World, World, WorldFollowing]):
    _, follower, told = pair
    t = follower.arm.time
    measured = inverse(follower.world_from_base(t)) @ follower.scene.world_from_board
    measured[:3, 3] += [0.02, -0.01, 0.003]
    told.board_seen(measured)
    assert inverse(follower.world_from_base(t)) @ follower.scene.world_from_board == pytest.approx(measured, abs=1e-9)


@pytest.mark.parametrize("row", [[1.0], [1.0, 2.0, 3.0], [float("nan"), 1.0], ["x", 1.0]])
def test_what_is_no_reading_is_refused(pair: tuple[World, World, WorldFollowing], row):
    with pytest.raises((ValueError, TypeError)):
        pair[2].tell("rail", [row])
