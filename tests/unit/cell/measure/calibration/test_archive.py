"""Promises of the archive, the paper's steps, the bound and the examination, on observations drawn independently."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.config.calibrations.store import nominal_camera, solve_observations
from cell.config.cell_config import load_config
from cell.measure.calibration import Priors, TargetObservation, calibrate_scan
from cell.measure.calibration.archive import Observations, read_archive, write_archive
from cell.measure.calibration.judge.advice import advice
from cell.measure.calibration.judge.coverage import Coverage, Places, derivatives, influences, place_rms
from cell.measure.calibration.solve.paper_steps import Crossing, paper_plane, step_3_keep_the_cross_ratio
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.poses import from_matrix, from_parts
from cell.measure.vision.board.view import BoardView
from drivers.errors import ConfigError
from lab.bench.calibration.bound import cramer_rao
from lab.bench.calibration.campaign import observe, one_trial
from lab.bench.calibration.world import Noise, draw_head

NOISE = Noise()


@pytest.fixture(scope="module")
def world():
    return draw_head(np.random.default_rng(1))


@pytest.fixture(scope="module")
def archived(world) -> Observations:
    scan = observe(world, NOISE, np.random.default_rng(2))
    config = load_config(None)
    camera = nominal_camera(config.scan_camera)
    priors = Priors(NOISE.arm / np.sqrt(3), NOISE.arm_angle, NOISE.rail)
    # The same views serve a camera without a rail, on a flange that went where the carriage had gone.
    head = calibrate_scan(scan, camera, np.array([1.0, 0.0, 0.0]), priors)
    along = head.flange_from_camera.rotation @ head.rail_direction
    target = [TargetObservation(o.view, o.base_from_flange * from_parts(o.rail_position * along), o.name) for o in scan]
    return Observations(scan, target, camera, camera, priors, 2e-3, {"arm": "A1", "rail": "R1"}, "abc", 1.7e9)


@pytest.fixture(scope="module")
def solved(archived):
    return solve_observations(archived)


def test_an_archive_solves_to_the_same_calibration(archived, solved, tmp_path):
    path = tmp_path / "a.observations.npz"
    write_archive(path, archived)
    again = solve_observations(read_archive(path)).calibration
    first, second = solved.calibration.as_dict(), again.as_dict()
    assert first["identities"] == second["identities"] and first["made"] == second["made"]
    for part in ("camera", "light_plane", "rail_direction", "flange_from_camera", "covariance", "quality"):
        np.testing.assert_allclose(_numbers(first["scan"][part]), _numbers(second["scan"][part]), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        first["target"]["hand_eye_covariance"], second["target"]["hand_eye_covariance"], rtol=0, atol=1e-12
    )


def _numbers(value) -> np.ndarray:
    if isinstance(value, dict):
        return np.concatenate([_numbers(v) for v in value.values()])
    return np.ravel(np.array(value, dtype=float))


def _rewritten(path: Path, **changes) -> None:
    with np.load(path) as file:
        data = {name: file[name] for name in file.files}
    for name, value in changes.items():
        if value is None:
            del data[name]
        else:
            data[name] = value(data[name].copy())
    with path.open("wb") as out:
        np.savez(out, **data)


def _not_a_number(array):
    array.flat[3] = np.nan
    return array


def _of_version_9(about):
    return np.array(json.dumps({**json.loads(str(about)), "format": 9}))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"scan_pixels": None}, "lacks 'scan_pixels'"),
        ({"about": None}, "lacks 'about'"),
        ({"about": _of_version_9}, "format 9, this program reads 1"),
        ({"about": lambda about: np.array("{")}, "cannot be solved"),
        ({"scan_pixels": _not_a_number}, "scan_pixels holds 1 values that are no numbers"),
        ({"scan_flange": lambda poses: 2 * poses}, "is no rotation"),
        ({"scan_sigma": lambda sigma: 0 * sigma}, "must be positive"),
        ({"scan_ids": lambda ids: ids + 1000}, "lie outside 0 to 98"),
        ({"stripe_centres": lambda centres: centres[:-1]}, "20 profiles of one length"),
        ({"scan_rail": lambda rail: rail[:4]}, "scan_rail must have shape"),
        ({"scan_rail": lambda rail: rail + 1e-6}, "changed after it was written: scan_rail;"),
        ({"sha256": None}, "its digest is missing"),
    ],
)
def test_a_bad_archive_is_refused_with_its_reason(archived, tmp_path, changes, says):
    path = tmp_path / "bad.observations.npz"
    write_archive(path, archived)
    _rewritten(path, **changes)
    with pytest.raises(ConfigError, match=says):
        read_archive(path)


def test_a_truncated_foreign_or_missing_file_is_refused(archived, tmp_path):
    path = tmp_path / "cut.observations.npz"
    write_archive(path, archived)
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", b"no archive at all", whole[:400] + b"\0" * 400 + whole[800:]):
        path.write_bytes(damaged)
        with pytest.raises(ConfigError, match="archive of observations"):
            read_archive(path)
    with pytest.raises(ConfigError, match="does not exist"):
        read_archive(tmp_path / "none.npz")


def test_the_paper_s_steps_find_the_plane_of_exact_views(world):
    exact = observe(world, replace(NOISE, dots=1e-9, stripe=1e-9, rail=1e-12, arm=1e-12, arm_angle=1e-12), _rng())
    camera = CameraModel(640, 480, 1.0, 1.0, 0.0, 0.0).with_parameters(world.lens)
    poses = [from_matrix(world.camera_from_board(k, np.zeros(7))) for k in range(len(exact))]
    stripes = [o.profile.pixels()[200:300] for o in exact]
    found = paper_plane(camera, poses, [o.view for o in exact], stripes)
    # The stripe's line is fitted without the print's rows left out, and the lens bends it by nothing that is left.
    np.testing.assert_allclose(found.plane.n / found.plane.distance, world.plane, rtol=1e-4, atol=2e-3)
    assert found.rms < 2e-6
    assert found.cross_ratio_m < 2e-6


def _rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_three_dots_give_the_cross_ratio(world):
    view = BoardView(world.spec, (640, 480), np.array([0, 4, 10]), np.zeros((3, 2)), np.ones(3))
    x = view.object_points[:, 0]
    t = np.array([0.1, 0.25, 0.6])
    place = 0.4
    got = step_3_keep_the_cross_ratio(
        Crossing(np.array([place, 0.0]), np.arange(3), 0), view, np.column_stack([t, np.zeros(3)])
    )[0]

    def ratio(a, b, c, d):
        return (c - a) * (d - b) / ((c - b) * (d - a))

    assert ratio(*x, got) == pytest.approx(ratio(*t, place), rel=1e-9)


def test_the_adjustment_states_the_deviations_of_the_bound(world, solved):
    bound = np.sqrt(np.diag(cramer_rao(world, NOISE).covariance))
    stated = np.sqrt(np.diag(solved.scan.adjusted.covariance))
    # fx … p2, rail and hand-eye.
    np.testing.assert_allclose(stated[:8], bound[:8], rtol=0.06)
    np.testing.assert_allclose(stated[12:21], bound[11:20], rtol=0.06)


@pytest.mark.campaign
def test_errors_lie_at_the_bound():
    trials = [one_trial(seed, NOISE) for seed in (11, 12)]
    for trial in trials:
        assert 0.93 < trial.chi2_per_dof < 1.07
        assert 0.93 < trial.chi2_drawn_noise < 1.07
        assert max(abs(z) for z in trial.z.values()) < 5
        assert trial.z_whitened == pytest.approx(trial.best_z_whitened, rel=0.1)
        # Where the scan frame lies is partly gauge; what a place feels is as good as the best on the same noise.
        for frame, most in {"scan": 1.35, "scan_aligned": 1.03, "base": 1.06}.items():
            assert trial.errors[frame]["mean"] < most * trial.errors[frame]["best_mean"]
        assert trial.errors["scan_aligned"]["mean"] < 1.1 * trial.errors["scan_aligned"]["bound_mean"]


def test_influences_and_advice_agree_with_the_covariance(world, solved):
    state, covariance = solved.scan.adjusted.state, solved.scan.adjusted.covariance
    places = Places(np.array([[320.0, 100], [330, 240], [310, 400]]), np.array([0.02, 0.05, 0.08]), world_flange(world))
    by_parameter = derivatives(state, covariance, places)
    figures = influences(by_parameter, covariance)
    draws = np.random.default_rng(4).multivariate_normal(np.zeros(21), covariance[:21, :21], 20_000)
    moved = np.einsum("nik,mk->mni", by_parameter, draws)
    assert figures["total_mm"] == pytest.approx(1e3 * np.sqrt(np.mean(np.sum(moved**2, axis=2))), rel=0.03)
    assert all(row["if_known_mm"] <= figures["total_mm"] * (1 + 1e-9) for row in figures["parameters"])
    # What each does alone and what each pair does together make the total.
    alone = {row["name"]: row["alone_mm"] for row in figures["parameters"]}
    pairs = 2e6 * np.triu(np.einsum("nik,kl,nil->kl", by_parameter, covariance[:21, :21], by_parameter), 1).sum() / 3
    assert sum(v**2 for v in alone.values()) + pairs == pytest.approx(figures["total_mm"] ** 2, rel=1e-6)
    # The cloud's covariance goes by variants of the calibration: they leave the points as uncertain.
    scan = solved.calibration.scan
    nominal = scan.geometry().solve(places.pixels, places.rails)[0]
    off = [variant.solve(places.pixels, places.rails)[0] - nominal for variant in scan.variants()]
    expected = figures["total_mm"] * solved.scan.adjusted.inflation
    assert 1e3 * np.sqrt(np.sum(np.square(off)) / len(nominal)) == pytest.approx(expected, rel=0.01)
    rows = advice(solved.scan, world.spec, (0.0, 0.1), lambda other: place_rms(by_parameter, other))
    assert all(row["gain"] > -1e-9 for row in rows)
    again = next(row for row in rows if row["what"].startswith("all present views"))
    # Twice the information of everything but the lens's weak prior: 1/√2 of the deviation.
    assert again["gain"] == pytest.approx(1 - np.sqrt(0.5), abs=0.03)


def world_flange(world):
    return from_matrix(world.flanges[0])


def test_coverage_counts_what_was_seen(solved, archived):
    seen = Coverage.of(solved.scan)
    assert seen.counts(seen.dots).sum() == sum(len(o.view.ids) for o in archived.scan)
    figures = seen.summary()
    assert figures["dots_rms_px"] == pytest.approx(NOISE.dots, rel=0.05)
    # The stripe's points are means of rows: as sure as all rows together, and they scatter as they state.
    stated = np.concatenate([view.stripe_sigma for view in solved.scan.views])
    assert np.sum(NOISE.stripe**2 / stated**2) == pytest.approx(sum(len(r) for r in solved.scan.staged.plane.rows))
    assert figures["stripe_rms_px"] == pytest.approx(np.sqrt(np.mean(stated**2)), rel=0.06)
