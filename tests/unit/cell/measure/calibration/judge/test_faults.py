"""Promises of the faults that a calibration names, on worlds that the simulator's optics and arm observe."""

from dataclasses import replace

import numpy as np
import pytest

from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import load_config
from cell.measure.calibration import Priors
from cell.measure.calibration.judge.faults import (
    SCALE_RANGE,
    refuse_bent,
    refuse_exchanged,
    refuse_slipped,
    refuse_wrong_lead,
)
from cell.measure.calibration.solve.joint import solve_joint, solve_staged
from cell.measure.vision.board.board import board_pose
from drivers.errors import RefusedError
from lab.bench.calibration.observed_cell import ObservedCell, shifted
from sim_backends.world.scene import draw

CONFIG = load_config(None)
PRIORS = Priors(CONFIG.arm.repeatability, CONFIG.arm.repeatability_angle, CONFIG.calibration.rail_sigma)
NOMINAL = nominal_camera(CONFIG.scan_camera)
ALONG = np.array([1.0, 0.0, 0.0])


def world(seed: int, level: str = "nominal") -> ObservedCell:
    return ObservedCell(draw(seed, level), CONFIG, np.random.default_rng([seed, 7]))


def rests(cell: ObservedCell) -> list:
    return [o for o in cell.collect_scan() if not o.same_rest]


def check(observations: list) -> None:
    """What a calibration does, without predicting held-out views."""
    staged = solve_staged(observations, NOMINAL, ALONG)
    names = [o.name for o in observations]
    refuse_exchanged(names, [o.base_from_flange for o in observations], staged.camera_from_board)
    joint = solve_joint(observations, staged, PRIORS, held_out=False)
    refuse_bent("fine", joint.adjusted, joint.views)
    poses = [board_pose(o.view, joint.adjusted.state.camera).camera_from_board for o in observations]
    refuse_slipped("scan", names, joint.adjusted, joint.views, poses)
    refuse_wrong_lead(joint.adjusted.state.rail_direction, CONFIG.rail.lead)


@pytest.mark.parametrize("scale", [0.0, 0.999 * SCALE_RANGE[0], 1.001 * SCALE_RANGE[1], np.nan])
def test_a_lead_outside_its_range_is_refused_with_what_the_screw_seems_to_have(scale):
    with pytest.raises(RefusedError, match=r"per mm commanded.*rail\.lead is configured as 2 mm"):
        refuse_wrong_lead(scale * ALONG, 0.002)
    refuse_wrong_lead(1.001 * SCALE_RANGE[0] * ALONG, 0.002), refuse_wrong_lead(0.999 * SCALE_RANGE[1] * ALONG, 0.002)


def test_good_observations_are_not_refused():
    check(rests(world(11, "harsh")))


@pytest.mark.parametrize(("level", "pair"), [("nominal", (4, 11)), ("harsh", (0, 17))])
def test_exchanged_pictures_are_named(level, pair):
    observations = rests(world(3, level))
    first, second = (observations[k] for k in pair)
    observations[pair[0]] = replace(first, view=second.view, profile=second.profile)
    observations[pair[1]] = replace(second, view=first.view, profile=first.profile)
    staged = solve_staged(observations, NOMINAL, ALONG)
    with pytest.raises(RefusedError, match=f"fine {pair[0] + 1} and fine {pair[1] + 1} are exchanged"):
        refuse_exchanged([o.name for o in observations], [o.base_from_flange for o in observations],
                         staged.camera_from_board)  # fmt: skip


def test_frames_that_come_one_late_are_named():
    good = rests(world(3))
    late = [replace(o, view=good[k - 1].view, profile=good[k - 1].profile) for k, o in enumerate(good)]
    with pytest.raises(RefusedError, match="one late"):
        check(late)


def test_a_bent_board_is_named_with_its_bend():
    cell = world(3)
    cell.bend = 0.3e-3
    with pytest.raises(RefusedError, match=r"not flat: its dots stand 0\.(29|30|31) mm"):
        check(rests(cell))


def test_a_slipped_mount_is_named_with_the_view():
    cell, size = world(3), 0.3e-3
    before = rests(cell)
    cell.truth = replace(cell.truth, flange_from_scan=cell.truth.flange_from_scan @ shifted(np.array([size, 0, 0])))
    after = rests(cell)
    with pytest.raises(RefusedError, match=r"slipped on the flange before fine (9|10|11)"):
        check(before[:9] + after[9:])


def test_what_an_arm_may_err_by_at_its_postures_is_no_slip():
    cell = world(3)
    before = rests(cell)
    cell.truth = replace(cell.truth, flange_from_scan=cell.truth.flange_from_scan @ shifted(np.array([1e-4, 0, 0])))
    check(before[:9] + rests(cell)[9:])


def test_a_wrong_lead_is_named_with_the_right_one():
    cell, scale = world(3), 1.25
    cell.truth = replace(cell.truth, rail_direction=scale * cell.truth.rail_direction)
    with pytest.raises(RefusedError, match=rf"configured as 2 mm, the screw seems to have {2 * scale:.1f}"):
        check(rests(cell))
