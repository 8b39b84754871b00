"""Promises of the examination of a calibration: what was seen, what limits it, and what would better it."""

import numpy as np
import pytest

from cell.measure.calibration.judge.coverage import Coverage, Places, advice, derivatives, influences, place_rms
from cell.measure.geometry.poses import from_matrix
from lab.bench.calibration.world import Noise


def test_influences_and_advice_agree_with_the_covariance(world, solved):
    state, covariance = solved.scan.adjusted.state, solved.scan.adjusted.covariance
    pixels, rails = np.array([[320.0, 100], [330, 240], [310, 400]]), np.array([0.02, 0.05, 0.08])
    places = Places(pixels, rails, from_matrix(world.flanges[0]))
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


def test_coverage_counts_what_was_seen(solved, archived):
    seen = Coverage.of(solved.scan)
    assert seen.counts(seen.dots).sum() == sum(len(o.view.ids) for o in archived.scan)
    figures = seen.summary()
    assert figures["dots_rms_px"] == pytest.approx(Noise().dots, rel=0.05)
    # The stripe's points are means of rows: as sure as all rows together, and they scatter as they state.
    stated = np.concatenate([view.stripe_sigma for view in solved.scan.views])
    assert np.sum(Noise().stripe ** 2 / stated**2) == pytest.approx(sum(len(r) for r in solved.scan.staged.plane.rows))
    assert figures["stripe_rms_px"] == pytest.approx(np.sqrt(np.mean(stated**2)), rel=0.06)
