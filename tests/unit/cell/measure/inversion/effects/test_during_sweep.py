"""A vehicle that rocks while the laser sweeps: seen in a made-up scan of known motion, and not seen where it stands."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cell.config.job import load_job
from cell.measure.geometry.poses import difference
from cell.measure.inversion import NominalSurface, PlacePose, Prior, Tolerance, invert_pose
from cell.measure.inversion.effects.during_sweep import (
    LARGEST_RAD,
    Head,
    Rocking,
    _Sweep,
    find_droop,
    find_rocking,
    rocking_covariance,
    rocking_motions,
    roll_of,
)
from cell.measure.reconstruction.cloud import Cloud, merge
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.steps.invert_pose import LineTimes
from cell.procedures.steps.invert_pose import invert_pose as step
from cell.procedures.steps.reconstruct import Reconstruction
from drivers.errors import RefusedError

JOB, MESH = load_job("pot")
NOMINAL = NominalSurface.load(MESH, unit=JOB.surface.mesh_unit)
SURFACE = pin.SE3(pin.utils.rotate("z", 0.3), np.array([0.75, 0.6, 0.05]))
VEHICLE = pin.SE3(np.eye(3), np.array([-0.3, 0.0, -0.55]))
RATE, LINES, NOISE = 30.0, 128, 8e-6
TIMES = np.arange(LINES) / RATE


def scanned(
    roll: float, pitch: float, hz: float, seed: int = 0, times: np.ndarray = TIMES, rows: int = 90
) -> Cloud:  # fmt: skip
    """Lines across the pot, taken at `times`, each displaced as the base was turned then, with noise on top."""
    rng, lines = np.random.default_rng(seed), len(times)
    low, high = NOMINAL.extent
    along = np.linspace(0.93 * low[0], 0.93 * high[0], lines)
    across = np.linspace(0.9 * low[1], 0.9 * high[1], rows)
    x, y = np.meshgrid(along, across, indexing="ij")
    start = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, high[2] + 1e-3)])
    for _ in range(8):
        # Straight down onto the surface.
        _, feet = NOMINAL.feet(start)
        start[:, 2] -= feet.heights / np.maximum(feet.normals[:, 2], 0.2)
    points = (start + np.array([0, 0, 1.0]) * NOISE * rng.standard_normal((len(start), 1))) @ SURFACE.rotation.T
    points = (points + SURFACE.translation).reshape(lines, rows, 3)
    wave = np.sin(2 * np.pi * hz * times + 0.7)
    for k in range(lines):
        turn = pin.exp3(wave[k] * np.array([roll, pitch, 0.0]))
        points[k] = (points[k] - VEHICLE.translation) @ turn.T + VEHICLE.translation
    spread = np.broadcast_to(np.array([0.0, 0.0, NOISE], dtype=np.float32), points.shape)
    flanges = np.tile(np.eye(4), (lines, 1, 1))
    return Cloud(points, spread, np.zeros((lines, 3)), np.zeros((lines, rows)), np.arange(lines) * 5e-4,
                 np.zeros((lines, rows), dtype=bool), flanges)  # fmt: skip


def test_each_sweep_rocks_by_itself():
    """A column moves the points of its own sweep alone, as the base turns about the vehicle's axes."""
    cloud, hz = scanned(0.0, 0.0, 1.3), 1.3
    cloud = replace(cloud, sweeps=np.repeat([0, 1], LINES // 2))
    lines, rows = np.array([0, 70, 100]), np.array([5, 40, 80])
    columns = rocking_motions(cloud, lines, rows, VEHICLE, TIMES, hz, size=1e-4)
    assert columns.shape == (3, 3, 8)
    arms = cloud.points[lines, rows] - VEHICLE.translation
    for k, line in enumerate(lines):
        phase = 2 * np.pi * hz * TIMES[line]
        moved = [np.cross(1e-4 * axis, arms[k]) * wave(phase)
                 for axis in VEHICLE.rotation[:, :2].T for wave in (np.sin, np.cos)]  # fmt: skip
        expected = np.zeros((3, 8))
        expected[:, 4 * (k > 0) : 4 * (k > 0) + 4] = np.column_stack(moved)
        np.testing.assert_allclose(columns[k], expected, atol=1e-12)


PRIOR = np.diag([1e-3**2] * 3 + [5e-3**2] * 3)


def placed(cloud: Cloud, hz: float | None) -> pin.SE3:

    def shaken(lines: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return rocking_motions(cloud, lines, rows, VEHICLE, TIMES, hz)

    sweeps = None if hz is None else shaken
    try:
        found = invert_pose(cloud, NOMINAL, Prior(SURFACE, PRIOR), Tolerance(6e-4, 6e-3), sweeps=sweeps)
        return found.base_from_surface
    except RefusedError as refused:
        # Unexplained, it may bend the surface too much; that pose is where the looking begins.
        assert hz is None
        return refused.seen["pose"]


@pytest.mark.parametrize(("roll", "pitch", "hz"), [(0.0, 1e-4, 4.0), (7e-5, -7e-5, 2.7), (1e-4, 0.0, 9.3)])
def test_rocking_is_seen_with_its_frequency_and_the_pose_is_freed_of_it(roll: float, pitch: float, hz: float):
    cloud = scanned(roll, pitch, hz)
    found = find_rocking(cloud, NOMINAL, placed(cloud, None), TIMES)
    assert found.hz == pytest.approx(hz, abs=0.1)
    beside = SURFACE.translation - VEHICLE.translation
    assert found.height == pytest.approx(abs(roll * beside[1] - pitch * beside[0]), rel=0.25)
    before, after = (difference(placed(cloud, f), SURFACE) for f in (None, found.hz))
    # The surface reaches 30 mm from its middle.
    assert np.linalg.norm(after[:3]) + 0.03 * np.linalg.norm(after[3:]) < 15e-6
    assert np.linalg.norm(after) <= np.linalg.norm(before) + 5e-6


def test_a_dense_scan_shows_what_its_lines_show():
    """Of so many lines 10,000 points are fewer than 8 each."""
    times = np.arange(1900) / 400.0
    rocks = scanned(0.0, 1e-4, 3.3, times=times, rows=16)
    found = find_rocking(rocks, NOMINAL, SURFACE, times)
    assert found is not None and found.hz == pytest.approx(3.3, abs=0.1)
    firm = replace(scanned(0.0, 0.0, 3.3, times=times, rows=16), rail=np.linspace(0.02, 0.08, len(times)))
    up = SURFACE.rotation[:, 2]
    down = pin.SE3(np.diag([1.0, -1.0, -1.0]), SURFACE.translation + 0.13 * up)
    head = Head.of(firm, pin.SE3.Identity(), down, np.array([1.0, 0.0, 0.0]), 0.1)
    assert find_droop(firm, NOMINAL, SURFACE, head) is None
    sunk = 0.3e-3 * head.share[:, None, None] ** 2 * up
    droop = find_droop(replace(firm, points=firm.points - sunk), NOMINAL, SURFACE, head)
    assert droop is not None and droop.sag == pytest.approx(0.3e-3, rel=0.1)


def test_a_vehicle_that_stands_is_not_said_to_rock():
    for seed in range(2):
        cloud = scanned(0.0, 0.0, 4.0, seed)
        assert find_rocking(cloud, NOMINAL, placed(cloud, None), TIMES) is None


@pytest.mark.parametrize("slower", [1, 4])
def test_a_sweep_repeated_more_slowly_shows_the_same_frequency(slower: int):
    times = 512.0 + slower * TIMES
    found = find_rocking(scanned(0.0, 1e-4, 2.6, times=times), NOMINAL, SURFACE, times)
    assert found is not None and found.hz == pytest.approx(2.6, abs=0.1)


@pytest.mark.parametrize("pause", [0.0, 5.13, -LINES / RATE])
def test_several_sweeps_have_a_phase_each(pause: float):
    later = TIMES + LINES / RATE + pause
    # With -LINES / RATE the clock begins anew.
    clouds = [scanned(0.0, 1e-4, 4.0, 0), scanned(0.0, 1e-4, 4.0, 1, later + 0.125)]
    found = find_rocking(merge(clouds), NOMINAL, SURFACE, np.concatenate([TIMES, later]))
    assert found is not None and found.hz == pytest.approx(4.0, abs=0.1)


def test_sweeps_that_lie_on_each_other_by_a_step_do_not_rock():
    clouds = [scanned(0.0, 0.0, 4.0, seed) for seed in range(3)]
    clouds[1].points[:, :, 2] += 6e-5
    times = np.concatenate([TIMES + 5.0 * k for k in range(3)])
    assert find_rocking(merge(clouds), NOMINAL, SURFACE, times) is None


@pytest.mark.parametrize(
    ("kept", "times"), [(0, TIMES), (20, TIMES), (LINES, np.zeros(LINES))], ids=["none", "few", "no times"]
)
def test_few_lines_and_times_that_tell_none_apart_tell_of_no_rocking(kept: int, times: np.ndarray):
    cloud = scanned(0.0, 1e-4, 4.0)
    cloud.points[kept:] = np.nan
    assert find_rocking(cloud, NOMINAL, SURFACE, times) is None


@pytest.mark.parametrize("times", [2, 3])
def test_an_overtone_is_told_by_its_size(times: int):
    heights = 1e-5 * (np.sin(2 * np.pi * 2.0 * TIMES) + 0.4 * np.sin(2 * np.pi * 2.0 * times * TIMES + 0.3))
    sweep = _Sweep.of(TIMES, heights, np.outer(TIMES, [0.015, 0.0, 0.0]))
    assert sweep is not None and sweep.overtones(2.0) == pytest.approx(0.4, abs=0.02)


def test_what_is_stated_for_the_moment_of_placing_is_the_mean_square():
    covariance = rocking_covariance(Rocking(4.0, 1e-4, 3.75e-3), VEHICLE, SURFACE.translation)
    beside = float(np.linalg.norm((SURFACE.translation - VEHICLE.translation)[:2]))
    assert covariance[3, 3] == pytest.approx(0.5 * (1e-4 / beside) ** 2)
    assert covariance[2, 2] == pytest.approx(0.5 * 1e-4**2)


def test_a_roll_that_photographs_show_shifts_the_place_to_the_side_where_the_scan_shows_less():
    arm = SURFACE.translation - VEHICLE.translation
    alone = rocking_covariance(None, VEHICLE, SURFACE.translation, 2e-4)
    way = np.array([*np.cross([1.0, 0.0, 0.0], arm), 1.0, 0.0, 0.0])
    np.testing.assert_allclose(alone, 0.5 * 2e-4**2 * np.outer(way, way), atol=1e-20)
    seen = Rocking(4.0, 1e-4, 3.75e-3)
    both = rocking_covariance(seen, VEHICLE, SURFACE.translation, 2e-4)
    pitch = rocking_covariance(seen, VEHICLE, SURFACE.translation)[4, 4]
    assert (both[3, 3], both[4, 4]) == pytest.approx((0.5 * 2e-4**2, pitch))


def test_a_board_that_a_roll_does_not_move_tells_of_a_roll_that_is_refused():
    beside = pin.SE3(np.eye(3), VEHICLE.translation + np.array([1.0, 0.0, 0.0]))
    assert roll_of(0.0, beside, VEHICLE) == 0.0
    assert roll_of(20e-6, beside, VEHICLE) > LARGEST_RAD


def test_a_vehicle_that_rocks_too_much_is_waited_for():
    with pytest.raises(RefusedError, match=r"rocks.*Wait until it is quiet"):
        rocking_covariance(Rocking(3.0, 4 * LARGEST_RAD, 5e-3), VEHICLE, SURFACE.translation)


def test_a_refused_scan_stays_refused_and_both_readings_are_told():
    with pytest.raises(RefusedError, match=r"off the nominal.*the vehicle rocks at .* Hz.*waves of [\d.]+ mm"):
        inverted(worn(300e-6, 8e-3, seed=1))


def test_lands_and_ridges_are_not_taken_for_rocking():
    for seed, length in enumerate((6e-3, 9.5e-3)):
        cloud = worn(350e-6, length, sharp=True, seed=seed)
        assert find_rocking(cloud, NOMINAL, SURFACE, TIMES) is None
    with pytest.raises(RefusedError, match=r"^(?!.*rocks)"):
        inverted(cloud)


def test_where_it_is_accepted_the_note_names_the_waves_that_look_the_same():
    (note,) = inverted(scanned(0.0, 3e-5, 4.0)).notes
    pace = 0.93 * np.ptp(NOMINAL.extent, axis=0)[0] / (LINES - 1) * RATE
    told = re.search(r"rocks, or the surface has waves of ([\d.]+) mm", note)
    assert told is not None and float(told[1]) == pytest.approx(1e3 * pace / 4.0, rel=0.05)


def worn(height: float, length: float, *, sharp: bool = False, seed: int = 0) -> Cloud:
    """A scan from a firm vehicle of a surface with waves, or lands with edges, that follow each other along it."""
    cloud = scanned(0.0, 0.0, 4.0, seed)
    wave = np.sin(2 * np.pi * ((cloud.points - SURFACE.translation) @ SURFACE.rotation[:, 0]) / length + seed)
    up = height * ((wave > 0.3) if sharp else wave)
    return replace(cloud, points=cloud.points + up[:, :, None] * SURFACE.rotation[:, 2])


def inverted(cloud: Cloud) -> PlacePose:
    """By the job's step, with a board that is where it is."""
    base_from_board = SURFACE * JOB.surface.place_from_surface.se3().inverse() * JOB.place_from_board
    fix = BoardFix(base_from_board, PRIOR, 0.1, 0.0, ())

    def still(lines: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return np.zeros((len(lines), 3, 1))

    scan = Reconstruction(cloud, (), still, still)
    return step(scan, fix, JOB, NOMINAL, np.zeros((6, 6)), LineTimes(TIMES, VEHICLE))
