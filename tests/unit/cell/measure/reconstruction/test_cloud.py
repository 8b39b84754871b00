"""Sweeps from several poses make one cloud; their seams show what the poses err by; the arm alone can sweep too."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_parts, from_ur, to_ur
from cell.measure.reconstruction.build import ProfileBuilder, calibration_motions, flange_motions, lean_motions
from cell.measure.reconstruction.cloud import Cloud, find_seams, merge
from cell.measure.vision.stripe.profile import StripeProfile
from cell.motion.trajectory import FlangeTrack
from drivers.clock import ClockMap, Latch
from drivers.errors import DeviceFault
from drivers.interfaces import ArmSafety, ArmState
from lab.bench.reconstruction.scenes import swept
from tests.unit.cell.measure.reconstruction.test_build import BASE_FROM_FLANGE, GEOMETRY, MOUNT, RAIL, TABLE, profile

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
NOISE = 0.07


def relief(x: Array, y: Array) -> Array:
    """Height in the base, m."""
    return np.asarray(TABLE + 0.002 * np.sin(120 * x) * np.cos(140 * y))


def stripe(base_from_camera: pin.SE3) -> Array:
    """Columns (480,) at which the laser line on the relief is seen: each image row's ray in the light plane, by
    bisection between the heights that the relief stays within."""
    camera, plane = GEOMETRY.camera, GEOMETRY.light_plane
    low, high = np.zeros(480), np.full(480, 639.0)

    def above(column: Array) -> Array:
        seen = plane.intersect(camera.rays(np.column_stack([column, np.arange(480.0)])))
        points = seen @ base_from_camera.rotation.T + base_from_camera.translation
        return np.asarray(points[:, 2] - relief(points[:, 0], points[:, 1]))

    sign = np.sign(above(low))
    for _ in range(34):
        middle = 0.5 * (low + high)
        same = np.sign(above(middle)) == sign
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.asarray(0.5 * (low + high))


def noisy(centres: Array, rng: np.random.Generator) -> StripeProfile:
    return profile(centres + NOISE * rng.standard_normal(480), NOISE)


def scanned(shift: tuple[float, float, float], error: Array, seed: int, lines: int = 16) -> Cloud:
    """A rail sweep from a flange moved by `shift`, which is told to stand `error` (translation) from where it is."""
    rng = np.random.default_rng(seed)
    true = from_parts(shift) * BASE_FROM_FLANGE
    profiles = (
        (noisy(stripe(true * MOUNT * from_parts(rail * RAIL)), rng), rail) for rail in np.linspace(0.047, 0.053, lines)
    )
    return swept(GEOMETRY, profiles, 1e-6, from_parts(error) * true)


ERROR = np.array([0.0, 0.0, 4e-5])


@pytest.fixture(scope="module")
def pair() -> Cloud:
    return merge([scanned((0, 0, 0), np.zeros(3), 1), scanned((0.0, 0.012, 0.0), ERROR, 2)])


def repeatability(sigma: float) -> list[Array]:
    return [np.diag([sigma**2] * 3 + [0.0] * 3)] * 2


def test_a_merged_cloud_is_wider_and_every_point_keeps_its_place(pair: Cloud):
    first, second = pair.each_sweep()
    assert pair.shape == (32, 480)
    assert pair.sweeps.tolist() == [0] * 16 + [1] * 16
    width = [np.ptp(pair.points[part][:, :, 1][pair.valid[part]]) for part in (first, second)]
    assert np.ptp(pair.points[:, :, 1][pair.valid]) > max(width) + 0.011
    deviation = pair.points[first][:, :, 2] - relief(*np.moveaxis(pair.points[first][:, :, :2], 2, 0))
    assert np.sqrt(np.nanmean(deviation**2)) < 5e-5


def test_the_seam_shows_the_error_between_two_sweeps_beside_what_is_expected(pair: Cloud):
    (seam,) = find_seams(pair, lambda lines, rows: flange_motions(pair, lines, rows, repeatability(4e-5 / np.sqrt(2))))
    assert (seam.first, seam.second) == (0, 1)
    assert seam.points > 500
    # The relief slopes a little, the error is along z: its part along the normals is nearly all of it.
    assert (abs(seam.mean), seam.expected_mean) == (pytest.approx(4e-5, rel=0.1), pytest.approx(4e-5, rel=0.05))
    assert seam.rms == pytest.approx(seam.expected_rms, rel=0.15)


def test_what_moves_both_sweeps_alike_is_not_expected_at_the_seam(pair: Cloud):
    def alike(lines: Indices, rows: Indices) -> Array:
        return np.full((len(lines), 3, 1), 1e-4)

    (seam,) = find_seams(pair, alike)
    assert seam.expected_mean < 2e-6


def test_a_sweep_without_neighbouring_lines_makes_no_seam(pair: Cloud):
    pair.points[0:15:2] = np.nan
    assert find_seams(pair, lambda lines, rows: flange_motions(pair, lines, rows, repeatability(1e-5))) == []


def test_a_pose_error_moves_its_own_sweep_as_the_motions_say():
    told = [np.zeros((6, 6)), np.diag([0, 0, 9e-10, 1e-8, 0, 0])]
    cloud = merge([scanned((0, 0, 0), np.zeros(3), 1, 8), scanned((0, 0.012, 0), np.zeros(3), 2, 8)])
    lines, rows = cloud.subsample(600)
    motions = flange_motions(cloud, lines, rows, told)
    covariance = np.einsum("nim,njm->nij", motions, motions)
    assert np.abs(covariance[lines < 8]).max() == 0.0
    arms = (cloud.points[lines, rows] - cloud.flanges[lines, :3, 3])[lines >= 8]
    by_turn = np.stack([-pin.skew(arm)[:, 0] for arm in arms])
    expected = 1e-8 * by_turn[:, :, None] * by_turn[:, None, :]
    expected[:, 2, 2] += 9e-10
    assert np.allclose(covariance[lines >= 8], expected, atol=1e-16)


def test_a_leaning_vehicle_moves_the_base_under_the_sweeps_as_the_motions_say(pair: Cloud):
    base_from_vehicle = pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.4])), np.array([-0.3, 0.1, -0.55]))
    springs = np.array([3e-4, 5e-4])

    def base(reach: Array) -> pin.SE3:
        """Where the base is in the world when the arm reaches out to `reach` in base axes."""
        along = base_from_vehicle.rotation.T @ reach
        lean = pin.exp3(np.array([-springs[1] * along[1], springs[0] * along[0], 0.0]))
        return base_from_vehicle * pin.SE3(lean, np.zeros(3)) * base_from_vehicle.inverse()

    lines, rows = pair.subsample(300)
    flanges = pair.flanges[:, :3, 3]
    middle = base(flanges.mean(axis=0))
    points = pair.points[lines, rows]
    # What stands still, seen from the base of the middle and from that of its own line.
    seen = np.array([base(flanges[k]).inverse() * middle * p for k, p in zip(lines, points, strict=True)])
    motions = [lean_motions(pair, lines, rows, base_from_vehicle, s)[:, :, k] for k, s in enumerate(springs[::-1])]
    np.testing.assert_allclose(sum(motions), seen - points, atol=2e-9)
    assert np.abs(seen - points).max() > 1e-6


def test_a_sweep_by_the_rail_alone_does_not_move_the_base():
    cloud = scanned((0, 0, 0), np.zeros(3), 1, 4)
    lines, rows = cloud.subsample(50)
    assert np.abs(lean_motions(cloud, lines, rows, pin.SE3.Identity(), 1e-3)).max() < 1e-12


def test_a_cloud_of_moving_flanges_is_solved_again_with_each_lines_own(pair: Cloud):
    lines, rows = pair.subsample(200)
    own = calibration_motions(pair, lines, rows, None, GEOMETRY, [GEOMETRY])
    assert np.abs(own).max() < 1e-12


def test_a_sweep_by_the_arm_lies_where_one_by_the_rail_does():
    rng = np.random.default_rng(3)
    builder = ProfileBuilder(GEOMETRY)
    flanges = []
    for k in range(24):
        turn = from_parts((0.0, 0.0, 0.0), pin.exp3(np.array([0.0, 2e-4 * k, -1e-4 * k])))
        flange = from_parts((0.0005 * k, 1e-5 * k, 0.0)) * BASE_FROM_FLANGE * turn
        builder.see(noisy(stripe(flange * MOUNT * from_parts(0.05 * RAIL)), rng))
        flanges.append(flange.homogeneous)
    cloud = builder.place(np.arange(24), np.array(flanges), np.full(24, 0.05), np.full((24, 3), 1e-7))
    lines, rows = np.nonzero(cloud.valid)
    assert len(lines) > 11_000
    points = cloud.points[lines, rows]

    x, y = points[:, 0], points[:, 1]
    slope_x, slope_y = (relief(x + 1e-7, y) - relief(x, y)) / 1e-7, (relief(x, y + 1e-7) - relief(x, y)) / 1e-7
    normals = np.column_stack([-slope_x, -slope_y, np.ones(len(points))])
    z = (points[:, 2] - relief(x, y)) / cloud.sigma_along(lines, rows, normals)
    assert np.std(z) == pytest.approx(1.0, abs=0.03)
    assert abs(np.mean(z)) < 0.05


def test_clouds_that_do_not_belong_together_are_not_merged():
    one = scanned((0, 0, 0), np.zeros(3), 1, 8)
    without = replace(one, flanges=np.empty((0, 4, 4)))
    with pytest.raises(ValueError, match="does not know where the flange stood"):
        merge([one, without])
    with pytest.raises(ValueError, match="no clouds"):
        merge([])
    assert merge([one]) is one


def states(delays: Array, period: float = 0.008) -> list[ArmState]:
    """A straight way at 20 mm/s and 0.1 rad/s about z, told with a delay of its own for each packet."""
    made = []
    for k, delay in enumerate(delays):
        time = k * period
        flange = pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.1 * time])), np.array([0.5 + 0.02 * time, 0.0, 0.3]))
        six = np.zeros(6)
        made.append(
            ArmState(1000.0 + time + delay, six, six, to_ur(flange), six, ArmSafety.NORMAL, True, 0, 0, 77.0 + time)
        )
    return made


CLOCKS = ClockMap()
CLOCKS.add([Latch(999.9999, 77.0, 1000.0001)])


@pytest.mark.parametrize("late", [0.0005, 0.2])
def test_late_packets_do_not_move_the_flange_not_even_if_all_are(late: float):
    delays = late + np.random.default_rng(0).exponential(0.004, 200)
    track = FlangeTrack("arm", states(delays), CLOCKS)
    times = 1000.0 + np.linspace(0.1, 1.5, 40)
    poses = track.at(times)
    assert np.abs(poses[:, 0, 3] - (0.5 + 0.02 * np.linspace(0.1, 1.5, 40))).max() < 1e-9
    angle = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    assert np.abs(angle - 0.1 * np.linspace(0.1, 1.5, 40)).max() < 1e-9
    assert track.inside(np.array([999.0, 1000.5, 1002.0])).tolist() == [False, True, False]


def test_a_pause_that_no_state_tells_of_leaves_the_way_there_unknown():
    whole = states(np.zeros(200))
    # For 64 ms nothing came. Either the arm went on evenly, or it stood still for half of that time and lags since.
    evenly = whole[:100] + whole[108:]
    paused = whole[:100] + [replace(late, flange=whole[k - 4].flange) for k, late in enumerate(whole[108:], start=108)]
    times = np.array([1000.4, 1000.82, 1001.2])
    assert FlangeTrack("arm", evenly, CLOCKS).even(times).tolist() == [True, True, True]
    assert FlangeTrack("arm", paused, CLOCKS).even(times).tolist() == [True, False, True]


def test_a_gap_in_the_states_is_a_fault_and_not_bridged():
    given = states(np.zeros(100))
    del given[40:80]
    with pytest.raises(DeviceFault, match=r"no state of the arm came for 0\.3\d* s"):
        FlangeTrack("arm", given, CLOCKS).at(np.array([1000.5]))
    with pytest.raises(DeviceFault, match="only 3 states"):
        FlangeTrack("arm", given[:3], CLOCKS)
    assert from_ur(given[0].flange).translation[0] == pytest.approx(0.5)
