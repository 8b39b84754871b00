"""A photograph of the station's board by the simulated camera: what it states, and what it refuses."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cell.config.calibrations.store import TargetCalibration
from cell.config.cell_config import load_config
from cell.config.job import PhotoSection, load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_matrix, from_parts
from cell.measure.vision.board.view import parse_board
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import Mover
from cell.procedures.arm.photograph import BoardFix, ScanPlan, look_pose, photograph
from cell.procedures.steps.workplace import PHOTO_RATE_HZ
from drivers.errors import RefusedError
from sim_backends.world.drawing import inverse
from tests.unit.cell.config.calibrations.test_store import made

CONFIG = load_config(None)
JOB, _ = load_job("pot")
BOARD = parse_board(JOB.board.spec)


@pytest.fixture(scope="module")
def cell() -> VirtualCell:
    """At its target, with the camera 100 mm beside the looking pose: the board is seen a little from the side."""
    cell = VirtualCell(CONFIG, seed=1, level="ideal")
    model, target = cell.world.vehicle, JOB.approach.target.se3()
    model._x, model._y = target.translation[:2]
    cell.clock.sleep(0.1)
    cell.devices.vehicle.brake()
    mover = Mover(cell.devices.arm, cell.clock, CONFIG, JOB)
    mover.to_joints(HOME)
    square = look_pose(CONFIG, JOB, BOARD, calibration().flange_from_camera)
    mover.to(from_parts((0.0, 0.1, 0.0)) * square, "a pose beside the looking pose")
    cell.devices.target_camera.configure(CONFIG.target_camera.photo_exposure, PHOTO_RATE_HZ)
    return cell


def calibration() -> TargetCalibration:
    """As drawn, which an ideal cell is, and known without error: what a photograph states is its own."""
    drawn = made().target
    return replace(
        drawn, flange_from_camera=CONFIG.target_camera.flange_from_camera.se3(), hand_eye_covariance=np.zeros((6, 6)),
    )  # fmt: skip


def photographed(cell: VirtualCell, count: int = 1, **limits: float) -> BoardFix:
    photo: PhotoSection = JOB.photo.model_copy(update=limits)
    return photograph(
        cell.devices.arm, cell.devices.target_camera, calibration(), BOARD, photo, np.zeros((6, 6)), count
    )


def test_the_board_is_where_it_truly_is_and_more_photographs_know_it_better(cell: VirtualCell):
    once, often = photographed(cell), photographed(cell, 4)
    truth = from_matrix(inverse(cell.world.world_from_base(cell.clock.now())) @ cell.world.scene.world_from_board)
    for fix in (once, often):
        assert np.linalg.norm(fix.base_from_board.translation - truth.translation) < 1e-3
    assert len(often.frames) == len(often.views) == 4
    assert np.trace(once.covariance) / np.trace(often.covariance) == pytest.approx(4.0, rel=0.3)


def test_a_board_that_is_seen_too_obliquely_or_not_as_it_is_is_refused_and_shown(cell: VirtualCell):
    fix = photographed(cell)
    for limit, words in (
        ({"max_obliquity": 0.9 * fix.obliquity}, "deg from square, allowed up to"),
        ({"max_residual": 0.5 * fix.residual_px}, "px RMS, allowed up to"),
    ):
        with pytest.raises(RefusedError, match=words) as refused:
            photographed(cell, **limit)
        (number,) = refused.value.numbers
        assert number.value > number.most
        assert refused.value.seen["view"] is not None
    assert 4.0 < math.degrees(fix.obliquity) < 9.0
    photographed(cell, max_obliquity=1.1 * fix.obliquity, max_residual=2.0 * fix.residual_px)


def test_a_way_back_begins_where_the_sweep_ends():
    plan = ScanPlan(from_parts((0.1, 0.0, 0.0)), from_parts((0.2, 0.0, 0.0)), 0.018, 0.082)
    assert plan.back == ScanPlan(plan.base_from_flange_end, plan.base_from_flange, 0.082, 0.018) and plan.back != plan
