"""The workshop's effects in the simulated world: each is off unless asked for, and as large as told."""

import dataclasses

import numpy as np
import pytest

from cell.measure.inversion.effects.causes import Cause, likeliest
from lab.bench.job.realism import verdict
from sim_backends.clock import SteppedClock
from sim_backends.models.arm_kinematics import UR10E_DH, JointErrors, Kinematics
from sim_backends.optics.pattern import grain_at, grain_parameters
from sim_backends.optics.scene import Grain
from sim_backends.world import drawing
from sim_backends.world.cameras import SKY
from sim_backends.world.levels import ALONE, CUT, HARSH, IDEAL, NOMINAL, OUTDOOR, Effects, deviations, effects_of, only
from sim_backends.world.scene import draw
from sim_backends.world.world import World

RNG = np.random.default_rng(0)


def test_every_effect_can_be_had_alone_and_workshop_has_all_but_the_options():
    for name in Effects.names():
        alone = effects_of(f"nominal+{name}")
        assert getattr(alone, name) == getattr(ALONE, name) > 0
        assert sum(bool(getattr(alone, other)) for other in Effects.names()) == 1
    off = [name for name in Effects.names() if not getattr(effects_of("workshop"), name)]
    assert off == ["rolling_shutter", "droop", "oil", *OUTDOOR]
    assert effects_of("outdoor") == only(*OUTDOOR)
    for level in ("ideal", "nominal", "harsh"):
        assert effects_of(level) == Effects()


def test_the_sun_has_20_to_100_klx_by_seed():
    drawn = [draw(seed, "outdoor").workshop.klx for seed in range(40)]
    assert 20.0 <= min(drawn) < 30.0 and 90.0 < max(drawn) <= 100.0
    assert draw(3, "workshop").workshop.klx == 0.0


def test_in_the_open_gusts_come_and_go_the_ground_is_uneven_and_the_mount_grows():
    world = World(3, "outdoor", clock=SteppedClock())
    flat = World(3, "nominal", clock=SteppedClock())
    tilts = [np.linalg.inv(flat.world_from_base(0.0)) @ world.world_from_base(t) for t in np.arange(0.0, 10.0, 0.01)]
    angles = np.array([[tilt[2, 1], tilt[0, 2]] for tilt in tilts])
    slope = world.scene.workshop.ground[:2]
    assert 0.0 < np.abs(angles.mean(axis=0)).max() <= np.abs(slope).max()
    off = np.linalg.norm(angles - angles.mean(axis=0), axis=1)
    assert off[450:550].max() == pytest.approx(0.05e-3, rel=0.1) and off[:50].max() < 0.01e-3
    cold = world.flange_from_camera("scan", 0.0)
    world.stand(3600.0)
    grown = world.flange_from_camera("scan", 0.0)[:3, 3] - cold[:3, 3]
    assert grown == pytest.approx(0.95 * world.scene.workshop.heat, rel=0.01) and np.abs(grown).max() > 1e-6


@pytest.mark.parametrize("effect", ["sheet_bow", "oil"])
def test_an_effect_leaves_everything_else_as_it_was(effect: str):
    plain, one = draw(5, "nominal"), draw(5, f"nominal+{effect}")
    assert np.any(getattr(one.workshop, effect)) and not np.any(getattr(plain.workshop, effect))
    assert (one.light_plane_normal == plain.light_plane_normal).all()
    assert (one.flange_from_part == plain.flange_from_part).all()
    assert deviations(f"nominal+{effect}") == deviations("nominal")


def test_joints_are_off_by_seven_hundredths_of_a_milliradian():
    off = []
    for seed in range(40):
        errors = JointErrors(Kinematics(UR10E_DH), draw(seed, "nominal+joint_harmonics").workshop.harmonics)
        for _ in range(20):
            q = RNG.uniform(-3, 3, 6)
            off.append(errors.true(q) - q)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(0.07e-3, rel=0.1)


def test_the_vehicle_rocks_by_a_tenth_of_a_milliradian_about_four_times_a_second():
    world = World(3, "nominal+rocking", clock=SteppedClock())
    # Leaning as it stands from the first tick on.
    times = np.arange(1.0, 11.0, 0.01)
    world.vehicle.tick(1.0)
    world.vehicle.tick(11.0)
    up = np.array([world.world_from_base(t)[:3, :3] @ (0.0, 0.0, 1.0) for t in times])
    lean = np.hypot(*(up[:, :2] - up[:, :2].mean(axis=0)).T)
    assert lean.max() == pytest.approx(0.1e-3, rel=0.35)
    power = np.abs(np.fft.rfft(up[:, 0] - up[:, 0].mean())) + np.abs(np.fft.rfft(up[:, 1] - up[:, 1].mean()))
    assert np.fft.rfftfreq(len(times), 0.01)[int(np.argmax(power))] == pytest.approx(4.0, abs=0.6)


def test_laser_and_cameras_drift_while_the_cell_stands_and_not_without_the_effects():
    for level, moves in (("nominal", False), ("nominal+laser_pointing+camera_warm_up", True)):
        world = World(4, level, clock=SteppedClock())
        before, lens = world.light_plane(0.0), world.lens("scan", 0.0)
        world.stand(7200.0)
        after = world.light_plane(0.0)
        turned = float(np.arccos(min(1.0, np.dot(before["normal"], after["normal"]))))
        assert (turned > 1e-5) == moves
        assert (world.lens("scan", 0.0) != lens) == moves
        if moves:
            assert turned == pytest.approx(abs(world.scene.workshop.pointing), rel=0.01)
            # About the exit point, which stays on the plane.
            assert np.dot(after["normal"], world.scene.laser_origin) == pytest.approx(after["distance"], abs=1e-12)


def test_texture_has_the_size_told_and_stays_on_the_surface():
    pattern = grain_parameters(0.6, Grain(texture=0.1))
    places = RNG.uniform(-0.05, 0.05, (4000, 2))
    albedo = np.array([grain_at(x, y, pattern) for x, y in places])
    assert albedo.mean() == pytest.approx(0.6, rel=0.02)
    assert albedo.std() / 0.6 == pytest.approx(0.1, rel=0.25)
    assert grain_at(*places[0], pattern) == albedo[0]


def test_a_carriage_that_droops_sinks_and_rolls_by_its_way_and_nothing_else_changes():
    plain, worn = (World(2, level, clock=SteppedClock()) for level in ("nominal", "nominal+droop"))
    for world in (plain, worn):
        world.rail.carriage = lambda t: t  # type: ignore[method-assign]
    assert np.array_equal(plain.scene.flange_from_scan_camera, worn.scene.flange_from_scan_camera)
    for way, sunk in ((0.0, 0.0), (0.05, 25e-6), (0.1, 100e-6)):
        moved = np.linalg.inv(plain.flange_from_camera("scan", way)) @ worn.flange_from_camera("scan", way)
        assert moved[:3, 3] == pytest.approx([0.0, 0.0, sunk], abs=1e-12)
        angle = np.arccos(np.clip((np.trace(moved[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
        assert angle == pytest.approx(10.0 * sunk, abs=1e-7)
    assert np.array_equal(plain.flange_from_camera("target", 0.1), worn.flange_from_camera("target", 0.1))


def test_the_fan_ends_and_the_sun_moves():
    assert only("sheet_ends").sheet_ends < np.deg2rad(30.0)
    world = World(1, "nominal+sunlight", clock=SteppedClock())
    facing = world.scene.world_from_surface @ drawing.pose((0.0, 0.0, 0.9), (1, 0, 0), (0, 0, -1))
    base = world.world_from_base(0.0)
    early = world._cameras.picture("target", facing, base, False, 0.004, t=0.0).astype(float)
    late = world._cameras.picture("target", facing, base, False, 0.004, t=100.0).astype(float)
    moved = np.abs(late - early)
    assert np.percentile(moved, 99.5) > 8.0 > 3.0 * np.median(moved)


def test_beyond_the_shadow_s_edge_it_is_as_much_brighter_as_the_sun_is_than_the_sky():
    world = World(1, "nominal+sun", clock=SteppedClock())
    ground, base = world.scene.world_from_place, world.world_from_base(0.0)

    def grey(x: float, t: float) -> float:
        facing = ground @ drawing.pose((x, -0.15, 0.13), (1, 0, 0), (0, 0, -1))
        return float(world._cameras.picture("scan", facing, base, False, 50e-6, t=t).mean())

    assert grey(0.18, 0.0) / grey(-0.2, 0.0) == pytest.approx(1.0 / SKY, rel=0.15)
    # The edge goes to and fro.
    over = [grey(world.scene.workshop.sun_start, t) for t in (0.0, 2.0, 6.0)]
    assert over[1] < 0.8 * over[0] < 0.8 * 0.8 * over[2]


@pytest.mark.parametrize("effect", [*Effects.names(), "workshop"])
def test_only_a_refusal_that_names_the_effect_is_excused(effect: str):
    elsewhere = "the arm, the camera and the laser's light: 3 points of the stripe cover the joint; held at the elbow"
    assert verdict({"outcome": "refused", "effect": effect, "reason": elsewhere}) == "refused"


def test_a_refusal_that_names_rocking_is_one_by_its_name():
    reason = f"the parts do not agree {likeliest([Cause('sway', 'the vehicle rocks at 4 Hz', 'line', 0.0, 0.9)])}"
    assert verdict({"outcome": "refused", "effect": "rocking", "reason": reason}) == "named"


def test_ideal_deviates_in_nothing_but_read_noise():
    values = dataclasses.asdict(IDEAL)
    assert 0 < values.pop("read_noise") <= 0.2
    assert set(values.values()) == {0.0}


def test_harsh_is_two_and_a_half_times_nominal():
    for name, value in dataclasses.asdict(NOMINAL).items():
        assert getattr(HARSH, name) == pytest.approx(2.5 * value), name


def test_unknown_levels_and_seeds_are_refused_with_the_choices():
    for level in ("noisy", "nominal+thunder", "workshop+grasp"):
        with pytest.raises(ValueError, match="choose"):
            effects_of(level)
    with pytest.raises(ValueError, match="ideal, nominal, harsh"):
        deviations("rough")
    with pytest.raises(ValueError, match="0 or greater"):
        draw(-1, "nominal")


def test_nominal_deviations_scatter_as_the_table_says_and_are_cut():
    shifts, turns = [], []
    for seed in range(200):
        scene = draw(seed, "nominal")
        moved = drawing.inverse(drawing.WORLD_FROM_PLACE) @ scene.world_from_surface
        shifts.append(moved[:3, 3])
        turns.append(np.linalg.norm(moved[:3, :3] - np.eye(3)) / np.sqrt(2.0))
    assert np.std(shifts) == pytest.approx(NOMINAL.station_translation, rel=0.1)
    assert np.abs(shifts).max() <= CUT * NOMINAL.station_translation + 1e-12
    assert np.sqrt(np.mean(np.square(turns)) / 3) == pytest.approx(NOMINAL.station_rotation, rel=0.1)
