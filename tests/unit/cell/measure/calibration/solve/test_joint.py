"""Promises of photographs between which only the rail moves: they share where the arm really stands."""

from dataclasses import replace

import numpy as np
import pytest

from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import load_config
from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.solve.joint import Joint, solve_joint, solve_staged
from cell.measure.calibration.solve.normal import rests_of
from cell.measure.geometry.poses import from_matrix
from lab.bench.calibration.campaign import observe
from lab.bench.calibration.world import HeadWorld, Noise, draw_head, turned

NOISE = Noise(arm=2e-4, arm_angle=4e-4)
PRIORS = NOISE.priors


def moved_at(world: HeadWorld, view: int, rng: np.random.Generator) -> list[ScanObservation]:
    """A view, and two more after the rail has moved 15 mm either way; the arm's departure is drawn once."""
    stands = turned(world.flanges[view], NOISE.own[:6] * rng.normal(size=6))
    rails = world.rails[view] + np.array([0.0, -0.015, 0.015])
    there = replace(world, flanges=np.array([stands] * 3), rails=rails)
    seen = observe(there, replace(NOISE, arm=1e-12, arm_angle=1e-12), rng)
    said = from_matrix(world.flanges[view])
    return [
        replace(o, base_from_flange=said, same_rest=k > 0, profile=None if k else o.profile) for k, o in enumerate(seen)
    ]


def solved(observations: list[ScanObservation]) -> Joint:
    nominal = nominal_camera(load_config(None).scan_camera)
    return solve_joint(observations, solve_staged(observations, nominal), PRIORS, held_out=False)


@pytest.mark.parametrize("seeds", [(3,), pytest.param((4, 5, 6), marks=pytest.mark.campaign)])
def test_moves_of_the_rail_at_rest_make_it_surer_as_stated(seeds):
    deviations, scores = [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        world = draw_head(rng)
        plain = observe(world, NOISE, rng)
        moved = [moved_at(world, view, rng) for view in (6, 10, 14)]
        both = [o for k, o in enumerate(plain) if k not in (6, 10, 14)] + [o for rest in moved for o in rest]
        joint = solved(both)
        before, after = solved(plain).adjusted, joint.adjusted
        deviations.append(np.sqrt(np.diag(after.covariance)[12:15] / np.diag(before.covariance)[12:15]))
        scores.append((after.state.rail_direction - world.rail) / np.sqrt(np.diag(after.covariance)[12:15]))
        assert 0.93 < after.chi2_per_dof < 1.07
        assert rests_of(joint.views).max() == len(plain) - 1
        flanges = [pose.homogeneous for pose in after.state.flanges[-3:]]
        np.testing.assert_allclose(flanges, flanges[:1] * 3, atol=1e-12)
    assert np.mean(deviations) < 0.4 and np.sqrt(np.mean(np.square(scores))) < 1.7
