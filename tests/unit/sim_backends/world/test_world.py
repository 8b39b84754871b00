"""The seeded world: what its levels promise, what a seed fixes, and how the part behaves on the surface."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from sim_backends import serve
from sim_backends.clock import History, SteppedClock, WorldClock, interpolate
from sim_backends.world import drawing
from sim_backends.world.bodies.contact import STIFFNESS, PartContact
from sim_backends.world.bodies.surfaces import HALF_X, HALF_Y, surface
from sim_backends.world.drawing import STOCK
from sim_backends.world.levels import CUT, HARSH, IDEAL, NOMINAL, deviations
from sim_backends.world.scene import draw, rotation
from sim_backends.world.world import World, truth


def turned(vector: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.array(vector))
    pose[:3, 3] = at
    return pose


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a[:3, :3] - b[:3, :3]) / np.sqrt(2.0))


# --- clock and history ---


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_clock_refuses_a_speed_that_does_not_advance(speed: float) -> None:
    with pytest.raises(ValueError, match="greater than 0"):
        WorldClock(speed)


def test_a_fast_clock_reaches_a_time_that_many_times_sooner() -> None:
    slow, fast = WorldClock(1.0), WorldClock(50.0)
    fast.sleep_until(1.0)
    assert fast.now() >= 1.0
    assert slow.now() == pytest.approx(fast.now() / 50.0, rel=0.2)


def test_history_interpolates_a_screw_motion_and_holds_its_ends() -> None:
    history = History()
    for t in np.arange(0.0, 2.0, 0.1):
        history.append(t, turned((0.0, 0.0, 0.5 * t), (t, 0.0, 0.0)))
    expected = turned((0.0, 0.0, 0.5 * 1.234), (1.234, 0.0, 0.0))
    assert history.at(1.234) == pytest.approx(expected, abs=1e-12)
    assert history.at(-1.0) == pytest.approx(history.at(0.0))
    assert history.at(99.0) == pytest.approx(history.at(1.9))


def test_history_forgets_what_is_older_than_it_keeps() -> None:
    history = History(keep=1.0)
    for t in np.arange(0.0, 5.0, 0.01):
        history.append(t, turned((0, 0, 0), (t, 0, 0)))
    assert history.at(0.0)[0, 3] == pytest.approx(4.0, abs=0.02)
    assert history.at(4.005)[0, 3] == pytest.approx(4.005)
    assert history.at(4.985)[0, 3] == pytest.approx(4.985)


def test_an_empty_history_says_so() -> None:
    with pytest.raises(LookupError, match="empty"):
        History().at(0.0)


def test_interpolation_stays_a_rotation_for_large_turns() -> None:
    halfway = interpolate(turned((0, 0, 0)), turned((1.0, -1.2, 0.3)), 0.5)
    assert halfway == pytest.approx(turned((0.5, -0.6, 0.15)), abs=1e-12)


# --- levels and scene ---


def test_ideal_deviates_in_nothing_but_read_noise() -> None:
    values = dataclasses.asdict(IDEAL)
    assert 0 < values.pop("read_noise") <= 0.2
    assert set(values.values()) == {0.0}


def test_harsh_is_two_and_a_half_times_nominal() -> None:
    for name, value in dataclasses.asdict(NOMINAL).items():
        assert getattr(HARSH, name) == pytest.approx(2.5 * value), name


def test_assumed_noise_states_value_unit_and_meaning_of_everything() -> None:
    table = NOMINAL.assumed_noise()
    assert set(table) == set(dataclasses.asdict(NOMINAL))
    assert table["arm_repeatability"] == {
        "sigma": 0.04e-3,
        "unit": "m",
        "of": "radial (1/√3 of it per axis), anew each time the arm settles",
    }
    assert all(entry["unit"] and entry["of"] for entry in table.values())


def test_unknown_levels_and_seeds_are_refused_with_the_choices() -> None:
    with pytest.raises(ValueError, match="ideal, nominal, harsh"):
        deviations("rough")
    with pytest.raises(ValueError, match="0 or greater"):
        draw(-1, "nominal")


def test_nominal_deviations_scatter_as_the_table_says_and_are_cut() -> None:
    shifts, turns = [], []
    for seed in range(200):
        scene = draw(seed, "nominal")
        moved = drawing.inverse(drawing.WORLD_FROM_PLACE) @ scene.world_from_surface
        shifts.append(moved[:3, 3])
        turns.append(angle(moved, np.eye(4)))
    assert np.std(shifts) == pytest.approx(NOMINAL.station_translation, rel=0.1)
    assert np.abs(shifts).max() <= CUT * NOMINAL.station_translation + 1e-12
    assert np.sqrt(np.mean(np.square(turns)) / 3) == pytest.approx(NOMINAL.station_rotation, rel=0.1)


# --- the part and the surface ---


def contact(
    name: str = "pot", lean: tuple[float, float, float] = (0.004, -0.006, 0.01)
) -> tuple[PartContact, np.ndarray]:
    world_from_surface = turned(lean, (0.01, -0.02, 0.6))
    return PartContact(surface(name), world_from_surface, drawing.FLANGE_FROM_PART), world_from_surface


def flange_for(world_from_part: np.ndarray) -> np.ndarray:
    return world_from_part @ drawing.inverse(drawing.FLANGE_FROM_PART)


def raised(pose: np.ndarray, dx: float = 0.0, dz: float = 0.0) -> np.ndarray:
    made = pose.copy()
    made[0, 3] += dx
    made[2, 3] += dz
    return made


@pytest.mark.parametrize("name", ["pot", "seat", "panel"])
def test_no_force_before_contact_and_stiffness_times_depth_after(name: str) -> None:
    part, target = contact(name, lean=(0.0, 0.0, 0.0))
    assert not part.wrench(flange_for(raised(target, dz=1e-4))).any()
    at_depth = [part.wrench(flange_for(raised(target, dz=-depth)))[2] for depth in (1e-4, 2e-4)]
    assert at_depth[1] == pytest.approx(2 * at_depth[0], rel=1e-3)
    # Slopes lower the vertical stiffness by cos² of the slope, averaged over the underside.
    assert 0.7 * STIFFNESS < at_depth[0] / 1e-4 < STIFFNESS


def test_contact_pushes_against_the_side_that_it_runs_into() -> None:
    part, target = contact(lean=(0.0, 0.0, 0.0))
    tilted = target @ turned((0.0, 0.02, 0.0))
    wrench = part.wrench(flange_for(raised(tilted, dz=0.0)))
    # Turned about +y, the side at +x is low; the force there, at +x of the flange, turns back about −y.
    assert wrench[2] > 0
    assert wrench[4] < 0


def test_released_on_the_surface_the_part_stays_where_it_was_placed() -> None:
    part, target = contact()
    part.set_claw(False, flange_for(target))
    assert not part.held
    assert part.part_pose(np.eye(4)) == pytest.approx(target, abs=1e-8)


def test_released_above_the_surface_the_part_falls_straight_down_onto_it() -> None:
    part, target = contact(lean=(0.0, 0.0, 0.0))
    part.set_claw(False, flange_for(raised(target, dz=0.008)))
    assert part.part_pose(np.eye(4)) == pytest.approx(target, abs=1e-7)


def test_a_part_that_was_pressed_in_springs_back_to_touch_the_surface() -> None:
    part, target = contact()
    part.set_claw(False, flange_for(raised(target, dz=-0.0004)))
    assert part.part_pose(np.eye(4))[2, 3] == pytest.approx(target[2, 3], abs=5e-6)


def test_a_part_put_down_beside_its_place_rests_higher_on_its_first_contact() -> None:
    part, target = contact()
    part.set_claw(False, flange_for(raised(target, dx=0.002, dz=0.002)))
    rest = part.part_pose(np.eye(4))
    assert rest[:2, 3] == pytest.approx(target[:2, 3] + [0.002, 0.0])
    x, y = (
        a.ravel() for a in np.meshgrid(np.linspace(-HALF_X, HALF_X, 21) * 0.9, np.linspace(-HALF_Y, HALF_Y, 11) * 0.9)
    )
    underside = np.column_stack([x, y, surface("pot").height(x, y), np.ones_like(x)])
    seen = (drawing.inverse(target) @ rest @ underside.T).T
    gap = seen[:, 2] - surface("pot").height(seen[:, 0], seen[:, 1])
    assert 0 < rest[2, 3] - target[2, 3] < 0.002
    assert gap.min() > -2e-5
    assert gap.min() < 2e-4


def test_dropped_beside_the_table_the_part_falls_to_the_floor() -> None:
    part, target = contact(lean=(0.0, 0.0, 0.0))
    part.set_claw(False, flange_for(raised(target, dx=-0.5)))
    assert part.part_pose(np.eye(4))[2, 3] < 0.01


def test_the_claw_grips_again_only_within_its_reach() -> None:
    part, target = contact()
    part.set_claw(False, flange_for(target))
    part.set_claw(True, flange_for(raised(target, dz=0.02)))
    assert not part.held
    part.set_claw(False, flange_for(raised(target, dz=0.02)))
    part.set_claw(True, flange_for(raised(target, dz=0.003)))
    assert part.held
    lifted = part.part_pose(flange_for(raised(target, dz=0.103)))
    assert lifted == pytest.approx(raised(target, dz=0.1), abs=1e-9)


def test_an_empty_claw_feels_the_table_with_its_fingers() -> None:
    part, target = contact(lean=(0.0, 0.0, 0.0))
    part.set_claw(False, flange_for(target))
    beside = raised(target, dx=0.1)
    tips_on_the_table = flange_for(beside)
    tips_on_the_table[2, 3] = target[2, 3] + 0.155
    assert not part.wrench(raised(tips_on_the_table, dz=1e-4)).any()
    assert part.wrench(raised(tips_on_the_table, dz=-0.01))[2] > 0


# --- the whole world, without its peers ---


class StandingWorld(World):
    """An ideal or nominal world whose vehicle stands at the station and whose arm is put wherever a test wants it."""

    def __init__(self, level: str = "ideal", seed: int = 5, surface: str = "pot") -> None:
        super().__init__(seed=seed, level=level, drawing=STOCK.with_surface(surface))
        self.base = drawing.pose((-0.75, 0.0, 0.55), (1, 0, 0), (0, 0, 1))

    def world_from_base(self, t: float) -> np.ndarray:
        return self.base

    def look(
        self, camera: str, world_from_camera: np.ndarray, exposure: float = 0.002, laser: bool = False
    ) -> np.ndarray:
        return self._cameras.picture(camera, world_from_camera, self.base, laser, exposure)


@pytest.fixture(scope="module")
def ideal() -> StandingWorld:
    return StandingWorld()


def above(point: tuple[float, float, float]) -> np.ndarray:
    """A camera that looks straight down from `point`, its x axis along world x."""
    return drawing.pose(point, (1, 0, 0), (0, 0, -1))


def test_the_stripe_on_the_table_is_where_the_closed_form_puts_it(ideal: StandingWorld) -> None:
    """x' = f (cot θ − l/Z), docs/explanation/theory.md, section 2, on the bare table beside the surface at Z = 130
    mm."""
    picture = ideal.look("scan", above((0.12, 0.0, 0.60 + 0.130)), laser=True).astype(float)
    dark = ideal.look("scan", above((0.12, 0.0, 0.60 + 0.130))).astype(float)
    light = (picture - dark)[40:440]
    light[light < 4] = 0.0
    centres = (light * np.arange(640)).sum(axis=1) / light.sum(axis=1)
    expected = 319.5 + 0.008 / 4.8e-6 * (1 / 3.5 - 0.035 / 0.130)
    assert centres.mean() == pytest.approx(expected, abs=0.01)
    assert centres.std() < 0.05


def test_the_stripe_follows_the_relief(ideal: StandingWorld) -> None:
    """Each lit pixel's ray, cut with the light plane, ends on the closed form of the surface."""
    world_from_camera = above((0.0, 0.0, 0.60 + 0.130))
    light = ideal.look("scan", world_from_camera, laser=True).astype(float) - ideal.look("scan", world_from_camera)
    light[light < 4] = 0.0
    rows = np.arange(30, 450)
    u = (light[rows] * np.arange(640)).sum(axis=1) / light[rows].sum(axis=1)
    ray = np.column_stack([(u - 319.5), (rows - 239.5), np.full(len(rows), 0.008 / 4.8e-6)]) / (0.008 / 4.8e-6)
    depth = 0.035 / (1 / 3.5 - ray[:, 0])
    points = ray * depth[:, None]
    x, y, z = points[:, 0], -points[:, 1], 0.130 - points[:, 2]
    on_it = np.abs(y) < HALF_Y - 0.001
    assert on_it.sum() > 300
    assert np.sqrt(np.mean((z - surface("pot").height(x, y))[on_it] ** 2)) < 1e-4


def test_the_target_camera_sees_the_boards_dots_where_a_pinhole_puts_them(ideal: StandingWorld) -> None:
    world_from_board = drawing.WORLD_FROM_PLACE @ drawing.PLACE_FROM_BOARD
    world_from_camera = world_from_board @ drawing.pose((0.08, 0.06, -0.9), (1, 0, 0), (0, 0, 1))
    picture = ideal.look("target", world_from_camera, exposure=0.008).astype(float)
    for i, j in [(0, 0), (8, 0), (0, 6), (8, 6)]:
        u, v = (
            (np.array([i * 0.02 - 0.08, j * 0.02 - 0.06]) / 0.9 * 0.008 / 4.8e-6 + [639.5, 511.5]).round().astype(int)
        )
        patch = 190.0 - picture[v - 14 : v + 15, u - 14 : u + 15]
        patch[patch < 60] = 0.0
        at = [(patch.sum(axis=axis) * np.arange(-14, 15)).sum() / patch.sum() for axis in (0, 1)]
        exact = np.array([i * 0.02 - 0.08, j * 0.02 - 0.06]) / 0.9 * 0.008 / 4.8e-6 + [639.5, 511.5]
        assert [u + at[0], v + at[1]] == pytest.approx(exact, abs=0.05)


def test_a_camera_that_looks_away_sees_only_the_room(ideal: StandingWorld) -> None:
    picture = ideal.look("target", drawing.pose((-0.75, 0.0, 1.5), (1, 0, 0), (0, 0, 1)), exposure=0.008)
    assert np.ptp(picture) < 30


def test_the_scan_camera_moves_along_the_rails_true_direction() -> None:
    world = StandingWorld("nominal")
    here = world.flange_from_camera("scan", 0.0)
    start = world.rail.carriage(0.0)
    moved = here[:3, 3] - world.scene.flange_from_scan_camera[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(start)
    assert here[:3, :3].T @ moved / start == pytest.approx(world.scene.rail_direction)


def test_the_arm_carries_laser_claw_and_grip_feedback_at_its_next_tick() -> None:
    world = StandingWorld()
    t = world.arm.time
    world.arm.tick(t + 0.01)
    assert world.part.held
    assert world.arm.digital_inputs & 1
    world.arm.write_digital_outputs(0b11, 0b01)
    world.arm.tick(t + 0.02)
    assert not world.part.held
    assert not world.arm.digital_inputs & 1
    assert not world.laser.at(t + 0.015)
    assert world.laser.at(t + 0.025)


def test_pressing_the_part_down_is_felt_upward_in_base_axes() -> None:
    world = StandingWorld()
    on_the_surface = drawing.inverse(world.base) @ world.scene.world_from_surface
    on_the_surface[2, 3] -= 0.0005
    wrench = world.arm.contact(on_the_surface @ drawing.inverse(drawing.FLANGE_FROM_PART))
    assert 5.0 < wrench[2] < 10.0


def test_the_body_leans_towards_where_the_arm_reaches() -> None:
    world = World(seed=2, level="nominal")
    world.arm.tick(0.5)
    world.vehicle.tick(0.6)
    reach = world.arm.base_from_flange(0.5)[:3, 3]
    up = world.vehicle.world_from_vehicle(0.6)[:3, 2]
    assert np.hypot(*up[:2]) > 0
    assert up[0] * reach[0] >= 0
    assert up[1] * reach[1] >= 0


def test_truth_is_complete_json_and_consistent() -> None:
    world = World(seed=9, level="nominal")
    told = json.loads(json.dumps(truth(world)))
    pose = {name: np.array(value) for name, value in told["poses"].items()}
    assert pose["world_from_base"] @ pose["base_from_surface"] == pytest.approx(pose["world_from_surface"])
    assert pose["base_from_flange"] @ pose["flange_from_part"] == pytest.approx(pose["base_from_part"])
    assert pose["base_from_surface"] @ pose["surface_from_part"] == pytest.approx(pose["base_from_part"])
    assert told["assumed_noise"]["speckle_contrast"]["sigma"] == 0.15
    assert told["part"]["held"]
    assert not told["laser_on"]
    assert told["vehicle"]["stopped"]


# --- a picture of a moving camera ---


class LaggingClock(SteppedClock):
    """World time that passes while somebody sleeps; the arm's model of `world` follows it by `lag` s."""

    world: World | None = None
    lag = 0.0

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        assert self.world is not None
        self.world.arm.tick(self.now() - self.lag)


def lagging(lag: float) -> World:
    clock = LaggingClock()
    world = World(seed=1, level="nominal", clock=clock)
    clock.world, clock.lag = world, lag
    clock.step_to(1.0)
    return world


def test_a_picture_waits_for_the_arm_to_come_to_its_exposure() -> None:
    world = lagging(0.015)
    assert serve.picture(world, "scan", 1.0, 0.002).shape == (480, 640)
    assert 1.0 <= world.arm.time < 1.0 + 2 * serve.PERIOD


def test_a_picture_does_not_wait_for_ever() -> None:
    world = lagging(5.0)
    assert serve.picture(world, "scan", 1.0, 0.002).shape == (480, 640)
    assert world.clock.now() == pytest.approx(1.0 + serve.ARM_LAG, abs=2 * serve.PERIOD)
