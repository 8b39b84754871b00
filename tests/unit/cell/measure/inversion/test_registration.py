"""The pose found is the true one, its stated uncertainty is true, and what cannot be known is refused by name."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from numpy.typing import NDArray

from cell.measure.geometry.poses import difference, perturbed
from cell.measure.inversion import Demands, NominalSurface, PlacePose, Prior, Tolerance, invert_pose
from cell.measure.inversion.nominal import Scan
from cell.measure.inversion.observability import judge
from cell.measure.inversion.place_pose import balance
from cell.measure.inversion.registration import register
from cell.measure.reconstruction.cloud import Cloud, merge
from drivers.errors import ConfigError, NotObservable, RefusedError
from lab.bench.inversion.campaign import judge_case
from lab.bench.inversion.scenes import PARTS, TRUE, Setting, scan, start_away
from lab.bench.inversion.scenes import nominal as part_surface

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Height = Callable[[Array, Array], Array]

SIGMA = 40e-6
RAIL_SIGMA = 8e-6
JOB = Tolerance(translation=0.0006, rotation=0.006)
LOOSE = np.diag([0.008**2] * 3 + [np.radians(20) ** 2] * 3)
BOARD = np.diag([0.002**2] * 3 + [np.radians(0.6) ** 2] * 3)


freeform, seat, bowl = (PARTS[name].height for name in ("pot", "seat", "turned"))


def flat(x: Array, y: Array) -> Array:
    """A plane, m."""
    return 0.004 + 0.0 * x * y


def ledges(x: Array, y: Array) -> Array:
    """Two steep ledges that cross on a plane, m: of all points 0.7 and 1.3 % lie on them."""
    return 0.004 + 0.003 * np.clip(x / 0.0005, 0.0, 1.0) + 0.002 * np.clip((y - 0.004) / 0.0005, 0.0, 1.0)


@cache
def nominal(height: Height, half_x: float = 0.035, half_y: float = 0.018, step: float = 0.0005) -> NominalSurface:
    nx, ny = int(2 * half_x / step) + 1, int(2 * half_y / step) + 1
    x, y = np.meshgrid(np.linspace(-half_x, half_x, nx), np.linspace(-half_y, half_y, ny), indexing="ij")
    index = np.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = (each.ravel() for each in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    corners = np.stack([x.ravel(), y.ravel(), height(x.ravel(), y.ravel())], -1)
    return NominalSurface(corners, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]))


def scanned(
    height: Height, seed: int, *, true: pin.SE3 = TRUE, missing: float = 0.0, outliers: float = 0.01,
    sigma: float = SIGMA, shift: tuple[float, float] = (0.0015, -0.001),
) -> Cloud:  # fmt: skip
    """A cloud as a sweep gives it: the surface, the flat table around it, stripe and rail noise, outliers, gaps."""
    rng = np.random.default_rng(seed)
    lines, rows = 160, 240
    x, y = np.meshgrid(
        np.linspace(-0.036, 0.036, lines) + shift[0], np.linspace(-0.02, 0.02, rows) + shift[1], indexing="ij"
    )
    inside = (np.abs(x) < 0.035) & (np.abs(y) < 0.018)
    points = np.stack([x, y, np.where(inside, height(x, y), 0.0)], -1)
    across = np.array([0.06, 0.0, 1.0]) * sigma
    points += across * rng.standard_normal((lines, rows, 1))
    points[:, :, 0] += RAIL_SIGMA * rng.standard_normal((lines, 1))
    wild = rng.random((lines, rows)) < outliers
    points[wild, 2] += rng.uniform(-0.004, 0.004, int(wild.sum()))
    if missing:
        slant = x + 1.5 * y
        points[slant > np.quantile(slant, 1 - missing)] = np.nan
    spread = np.broadcast_to(across @ true.rotation.T, points.shape).astype(np.float32)
    return Cloud(
        points=points @ true.rotation.T + true.translation, stripe_spread=spread,
        rail_spread=np.tile(true.rotation[:, 0] * RAIL_SIGMA, (lines, 1)), centres=np.zeros((lines, rows)),
        rail=np.linspace(0, 0.07, lines), rejected=np.zeros((lines, rows), dtype=bool),
    )  # fmt: skip


def inverted(height: Height, cloud: Cloud, prior: Prior, **options: object) -> PlacePose:
    return invert_pose(cloud, nominal(height), prior, JOB, **options)  # type: ignore[arg-type]


def test_distances_to_the_mesh_are_those_to_the_closed_form_surface():
    surface = nominal(freeform, 0.015, 0.01, step=0.00025)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.014, 0.014, 1000), rng.uniform(-0.009, 0.009, 1000)
    gx, gy = (freeform(x + dx, y + dy) - freeform(x - dx, y - dy) for dx, dy in ((1e-6, 0), (0, 1e-6)))
    normal = np.stack([-gx / 2e-6, -gy / 2e-6, np.ones_like(x)], -1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = rng.uniform(-0.0004, 0.0004, 1000)
    found = surface.deviations(np.stack([x, y, freeform(x, y)], -1) + height[:, None] * normal)
    assert np.abs(found - height).max() < 2e-6


def test_points_beside_the_surface_have_no_deviation():
    beside = np.array([[0.0352, 0.0, 0.0], [0.0, 0.0185, 0.005], [0.06, 0.0, 0.0], [np.nan] * 3])
    assert np.all(np.isnan(nominal(freeform).deviations(beside)))


def test_a_mesh_is_read_in_its_unit_and_refused_in_the_wrong_one(tmp_path):
    surface = nominal(seat)
    path = tmp_path / "seat.stl"
    trimesh.Trimesh(surface.vertices * 1e3, surface.triangles).export(path)
    loaded = NominalSurface.load(path, unit="mm")
    assert loaded.radius == pytest.approx(surface.radius, rel=1e-6)
    with pytest.raises(ConfigError, match="mesh_unit = 'm'"):
        NominalSurface.load(path, unit="m")
    (tmp_path / "broken.stl").write_bytes(b"solid nonsense")
    with pytest.raises(ConfigError, match=r"broken\.stl"):
        NominalSurface.load(tmp_path / "broken.stl")


@pytest.mark.parametrize("height", [freeform, seat])
def test_the_true_pose_is_found_from_the_boards_with_the_uncertainty_stated(height: Height):
    rng = np.random.default_rng(5)
    scores = []
    for seed in range(6):
        prior = Prior(perturbed(TRUE, rng.normal(size=6) * np.sqrt(np.diag(BOARD))), BOARD)
        found = register(Scan.of(scanned(height, seed, missing=0.4 * (seed % 2)), 4000), nominal(height), prior)
        error = difference(found.base_from_surface, TRUE)
        assert np.linalg.norm(error[:3]) < 30e-6 and np.linalg.norm(error[3:]) < 1e-3
        scores.append(error @ np.linalg.solve(found.covariance, error))
    # The mean of six χ² variables of six degrees of freedom, within four of its standard deviations.
    assert 6 - 4 * np.sqrt(12 / 6) < np.mean(scores) < 6 + 4 * np.sqrt(12 / 6)


def test_a_prior_that_is_sharper_than_the_scan_is_followed():
    sharp = np.diag([1e-7**2] * 3 + [1e-6**2] * 3)
    board = perturbed(TRUE, [2e-5, -1e-5, 0, 0, 0, 1e-4])
    found = register(Scan.of(scanned(freeform, 1), 3000), nominal(freeform), Prior(board, sharp))
    assert np.abs(difference(found.base_from_surface, board)).max() < 1e-6


def test_sweeps_that_can_have_no_error_leave_the_pose_where_board_and_scan_have_it():
    prior = Prior(perturbed(TRUE, [2e-5, -1e-5, 1e-5, 0, 0, 1e-4]), np.diag([2e-6**2] * 3 + [1e-4**2] * 3))
    seen = Scan.of(scanned(freeform, 1), 3000)
    found = register(seen, nominal(freeform), prior)
    again = balance(found, seen, np.zeros((len(found.used), 3, 1)), prior)
    assert np.abs(difference(again.base_from_surface, found.base_from_surface)).max() < 1e-6
    np.testing.assert_allclose(np.diag(again.covariance), np.diag(found.covariance), rtol=0.05)


def test_an_uncertainty_that_all_points_share_is_added():
    arm = np.diag([1e-4**2] * 3 + [2e-4**2] * 3)
    pose = inverted(freeform, scanned(freeform, 2), Prior(TRUE, BOARD), systematic=arm)
    assert np.allclose(pose.systematic, arm, rtol=0.02)
    assert np.allclose(pose.covariance, pose.random + pose.systematic)


def test_the_calibrations_part_is_what_a_disturbed_calibration_does():
    """A scale error of the sweep and a shift of the whole cloud, as a calibration would leave them."""
    cloud, prior = scanned(freeform, 2), Prior(TRUE, BOARD)
    moved = np.stack(
        [np.array([1.0, 0.0, 0.0]) * 1e-3 * (cloud.points[:, :, :1] - 0.75), np.full_like(cloud.points, 5e-5)], -1
    )
    plain = inverted(freeform, cloud, prior)
    stated = inverted(freeform, cloud, prior, calibration=lambda lines, rows: moved[lines, rows])
    seen = np.zeros((6, 6))
    for k in range(2):
        other = replace(cloud, points=cloud.points + moved[:, :, :, k])
        step = difference(inverted(freeform, other, prior).base_from_surface, plain.base_from_surface)
        seen += np.outer(step, step)
    unit = np.sqrt(np.maximum(np.diag(seen), 1e-14))
    assert np.abs((stated.systematic - seen) / np.outer(unit, unit))[:3, :3].max() < 0.1


def test_sweeps_that_do_not_fit_each_other_do_not_tilt_the_surface():
    """Two strips that overlap by 8 mm, the second one 35 µm too high and 20 µm aside, as the arm's rest leaves them."""
    error, sigma = np.array([2e-5, -1.5e-5, 3.5e-5]), 3e-5
    strips = []
    for seed, side, off in ((2, 1.0, 0.0), (3, -1.0, error)):
        strip = scanned(freeform, seed, outliers=0.0, sigma=1e-5)
        across = ((strip.points - TRUE.translation) @ TRUE.rotation)[:, :, 1:2]
        points = np.where(side * across > 0.004, np.nan, strip.points + off)
        strips.append(replace(strip, points=points, flanges=np.tile(np.eye(4), (len(points), 1, 1))))
    cloud, prior = merge(strips), Prior(TRUE, BOARD)

    def sweeps(lines: Indices, rows: Indices) -> Array:
        moved = np.zeros((len(lines), 3, 6))
        for k in range(2):
            moved[cloud.sweeps[lines] == k, :, 3 * k : 3 * k + 3] = sigma * np.eye(3)
        return moved

    as_they_lie = inverted(freeform, cloud, prior)
    told_apart = inverted(freeform, cloud, prior, sweeps=sweeps)
    assert np.linalg.norm(difference(as_they_lie.base_from_surface, TRUE)[3:]) > 5e-4
    off = difference(told_apart.base_from_surface, TRUE)
    assert np.abs(off[:3] - error / 2).max() < 8e-6 and np.abs(off[3:]).max() < 1.6e-4
    # The mean of two independent errors is what remains.
    assert told_apart.sigma[:3] == pytest.approx([sigma / np.sqrt(2)] * 3, rel=0.05)
    assert told_apart.sigma[3:].max() < 1e-4


def test_the_spin_of_a_bowl_is_not_determined_and_named():
    cloud = scanned(bowl, 1)
    with pytest.raises(NotObservable, match=r"rotation about the z axis .*is not determined: 3σ .* mrad > 6 mrad"):
        inverted(bowl, cloud, Prior(TRUE, BOARD))


def test_the_spin_stays_where_a_sharp_board_put_it():
    sharp = np.diag([0.002**2] * 3 + [0.001**2] * 3)
    board = perturbed(TRUE, [0.0005, -0.0005, 0.001, 0.0, 0.0, 0.0008])
    pose = inverted(bowl, scanned(bowl, 1), Prior(board, sharp))
    assert any("rotation about the z axis" in words for words in pose.verdict.unseen)
    assert difference(pose.base_from_surface, board)[5] == pytest.approx(0.0, abs=2e-4)
    assert np.linalg.norm((pose.base_from_surface.translation - TRUE.translation)[:2]) < 3e-5


def test_a_shift_that_only_a_wall_tells_is_left_to_the_board():
    """What the few points on a wall have in common moves the pose by many of the deviations that their noise gives."""
    cloud = scanned(ledges, 1)
    found = register(Scan.of(cloud, 4000), nominal(ledges), Prior(TRUE, BOARD))
    assert np.sqrt(found.covariance[0, 0]) < 20e-6
    with pytest.raises(NotObservable, match="is not determined"):
        inverted(ledges, cloud, Prior(TRUE, BOARD))
    board = perturbed(TRUE, [0.0001, 0.0001, 0.0001, 0.0, 0.0, 0.0])
    pose = inverted(ledges, cloud, Prior(board, np.diag([0.0001**2] * 3 + [0.001**2] * 3)))
    assert pose.verdict.unseen and pose.sigma[0] > 2 * np.sqrt(found.covariance[0, 0])
    off = difference(pose.base_from_surface, TRUE)
    assert abs(off[2]) < 1e-5 < 2e-5 < off[0] < 1.1e-4


@pytest.mark.parametrize("seed", range(2))
def test_a_prior_that_is_off_does_not_pull_the_pose_from_steep_walls(seed: int):
    """Their points are known to micrometres along their normals; a coarse pose is not."""
    prior = Prior(perturbed(TRUE, [0.005, 0.001, 0.001, 0.0, 0.0, 0.0]), BOARD)
    found = register(Scan.of(scanned(ledges, seed), 4000), nominal(ledges), prior)
    assert np.linalg.norm(difference(found.base_from_surface, TRUE)[:3]) < 1e-4


def test_a_freeform_surface_leaves_nothing_to_the_board():
    pose = inverted(freeform, scanned(freeform, 4), Prior(TRUE, BOARD))
    assert pose.verdict.unseen == ()
    assert not pose.verdict.weak


SHARP = np.diag([0.0002**2] * 3 + [0.001**2] * 3)


@pytest.mark.parametrize(
    ("height", "missing", "prior", "demands", "words"),
    [
        (seat, 0.0, Prior(TRUE, BOARD), Demands(), "nominal surface"),
        (freeform, 0.8, Prior(TRUE, BOARD), Demands(), "covers"),
        (freeform, 0.0, Prior(perturbed(TRUE, [0.2, 0, 0, 0, 0, 0]), BOARD), Demands(), "is the scan over it"),
        (freeform, 0.0, Prior(TRUE, BOARD), Demands(rms=2e-5), r"off the nominal surface, at most 0\.020 mm"),
        (freeform, 0.0, Prior(perturbed(TRUE, [0.003, 0, 0, 0, 0, 0]), SHARP), Demands(),
         r"scan and board disagree: the surface lies 3\.0\d mm"),
    ],
    ids=["another surface", "too little", "beside", "noise", "the board contradicts"],
)  # fmt: skip
def test_a_scan_that_does_not_fit_is_refused(
    height: Height, missing: float, prior: Prior, demands: Demands, words: str
):
    with pytest.raises(RefusedError, match=words):
        inverted(freeform, scanned(height, 1, missing=missing), prior, demands=demands)


@pytest.mark.parametrize("part", list(PARTS))
def test_every_part_is_found_from_far_away_with_foreign_objects_on_it_and_40_percent_missing(part: str):
    rng = np.random.default_rng(17)
    for setting in (Setting(clutter=0.2), Setting(clutter=0.1, missing=0.4)):
        cloud = Scan.of(scan(PARTS[part], rng, setting), 4000)
        found = register(cloud, part_surface(part), Prior(start_away(rng, 0.008, 20.0), LOOSE))
        off, turn = PARTS[part].error(found.base_from_surface, TRUE)
        assert off < 1e-4
        assert turn < 2e-3


def test_the_motions_that_a_sphere_leaves_open_are_named_one_by_one():
    with pytest.raises(NotObservable) as caught:
        invert_pose(scan(PARTS["cap"], np.random.default_rng(4)), part_surface("cap"), Prior(TRUE, BOARD), JOB)
    assert str(caught.value).count("is not determined: 3σ") == 3
    assert "rotation about the z axis of the surface frame is not determined" in str(caught.value)
    for axis in "xy":
        through = rf"rotation about the {axis} axis of the surface frame through \(-?0.0, -?0.0, -32.0\) mm is not"
        assert re.search(through, str(caught.value))


def test_a_plane_slides_along_two_axes_and_turns_about_its_normal():
    with pytest.raises(NotObservable) as caught:
        inverted(flat, scanned(flat, 1, outliers=0.0), Prior(TRUE, BOARD))
    assert str(caught.value).count("is not determined") == 3
    for motion in ("translation along the x axis", "translation along the y axis", "rotation about the z axis"):
        assert motion in str(caught.value)


def test_a_verdict_names_what_is_known_worst_with_three_of_its_deviations():
    sigmas = np.array([0.1e-3, 0.15e-3, 0.1e-3, 1e-3, 1e-3, 1e-3])
    known = judge(np.diag(sigmas**2), 1e9 * np.eye(6), 1.0, 1, 0.02, JOB)
    assert not known.weak
    assert known.worst.words.startswith("translation along the y axis of the surface frame is known: 3σ 0.45 mm ≤ 0.6")
    sigmas[[1, 5]] = 0.5e-3, 4e-3
    verdict = judge(np.diag(sigmas**2), 1e9 * np.eye(6), 1.0, 1, 0.02, JOB)
    assert [motion.words for motion in verdict.weak] == [
        "translation along the y axis of the surface frame is not determined: 3σ 1.5 mm > 0.6 mm",
        "rotation about the z axis of the surface frame is not determined: 3σ 12 mrad > 6 mrad",
    ]
    assert [motion.excess for motion in verdict.weak] == pytest.approx([2.5, 2.0])


@pytest.mark.parametrize("case", ["bent 0.3 to 3 mm", "turned by 180°", "mirrored"])
@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(1, 8), marks=pytest.mark.campaign)], ids=["few", "more"]
)
def test_no_surface_that_is_not_the_nominal_one_leads_outside_the_tolerance(case: str, seeds: range):
    ended = [judge_case(case, seed).ended for seed in seeds]
    assert "outside" not in ended
    assert "refused" in ended


def test_points_are_thinned_out_of_step_with_the_rows():
    cloud = scanned(freeform, 1)
    few = Scan.of(cloud, 400)
    assert (len(few.points), len(few.thinned(100).points)) == (400, 100)
    local = (few.points - TRUE.translation) @ TRUE.rotation
    occupied = np.histogram(local[:, 1], bins=20, range=(-0.021, 0.019))[0]
    assert occupied.min() >= 5
    assert np.histogram(few.thinned(100).points[:, 1], bins=5)[0].min() >= 5
