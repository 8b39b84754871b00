"""Promises of the archive, and of the adjustment beside the bound, on observations drawn independently."""

import json

import numpy as np
import pytest

from cell.config.calibrations.store import solve_observations
from cell.measure.calibration.archive import read_archive, write_archive
from drivers.errors import ConfigError
from lab.bench.calibration.campaign import cramer_rao, one_trial
from lab.bench.calibration.world import Noise


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


def _not_a_number(array):
    array.flat[3] = np.nan
    return array


def _of_version_9(about):
    return np.array(json.dumps({**json.loads(str(about)), "format": 9}))


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("scan_pixels", None, "lacks 'scan_pixels'"),
        ("about", None, "lacks 'about'"),
        ("about", _of_version_9, "format 9, this program reads 2"),
        ("about", lambda about: np.array("{"), "cannot be solved"),
        ("scan_pixels", _not_a_number, "scan_pixels holds 1 values that are no numbers"),
        ("scan_flange", lambda poses: 2 * poses, "is no rotation"),
        ("scan_sigma", lambda sigma: 0 * sigma, "must be positive"),
        ("scan_ids", lambda ids: ids + 1000, "lie outside 0 to 98"),
        ("stripe_centres", lambda centres: centres[:-1], "20 profiles of one length"),
        ("scan_rail", lambda rail: rail[:4], "scan_rail must have shape"),
        ("scan_rail", lambda rail: rail + 1e-6, "changed after it was written: scan_rail;"),
        ("sha256", None, "its digest is missing"),
    ],
)
def test_a_bad_archive_is_refused_with_its_reason(archived, tmp_path, name, change, says):
    path = tmp_path / "bad.observations.npz"
    write_archive(path, archived)
    with np.load(path) as file:
        data = {key: file[key] for key in file.files}
    value = data.pop(name)
    np.savez(path, **data, **({name: change(value.copy())} if change else {}))
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


def test_the_adjustment_states_the_deviations_of_the_bound(world, solved):
    bound = np.sqrt(np.diag(cramer_rao(world, Noise()).covariance))
    stated = np.sqrt(np.diag(solved.scan.adjusted.covariance))
    # fx … p2, rail and hand-eye.
    np.testing.assert_allclose(stated[:8], bound[:8], rtol=0.06)
    np.testing.assert_allclose(stated[12:21], bound[11:20], rtol=0.06)


@pytest.mark.campaign
def test_errors_lie_at_the_bound():
    trials = [one_trial(seed, Noise()) for seed in (11, 12)]
    for trial in trials:
        assert 0.93 < trial.chi2_per_dof < 1.07
        assert 0.93 < trial.chi2_drawn_noise < 1.07
        assert max(abs(z) for z in trial.z.values()) < 5
        assert trial.z_whitened == pytest.approx(trial.best_z_whitened, rel=0.1)
        # Where the scan frame lies is partly gauge; what a place feels is as good as the best on the same noise.
        for frame, most in {"scan": 1.35, "scan_aligned": 1.03, "base": 1.06}.items():
            assert trial.errors[frame]["mean"] < most * trial.errors[frame]["best_mean"]
        assert trial.errors["scan_aligned"]["mean"] < 1.1 * trial.errors["scan_aligned"]["bound_mean"]
