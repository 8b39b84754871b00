"""Gripping a part that lies: one that sticks, and one that something stands over."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pinocchio as pin

from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import difference, from_matrix, from_parts
from cell.procedures.grasp import GRIPPED, job_with_grasp
from lab.bench.job.whole_job import JobRecord
from tests.support.unloading import JOB, unloaded


def test_a_part_that_sticks_is_let_go_where_it_lies(placed_pot: JobRecord, tmp_path: Path) -> None:
    def sticks(cell: VirtualCell) -> None:
        cell.world.part.sticks = 60.0

    stuck = unloaded(placed_pot, sticks, runs=tmp_path)
    assert (stuck.outcome, stuck.stage) == ("refused", "pick")
    assert re.search(r"the part sticks, or is heavier .* pulled with more than 24 N and let go", stuck.reason)
    assert stuck.at_end and stuck.at_sweep and not stuck.at_end["part"]["held"] and stuck.folder is not None
    moved = difference(*(from_matrix(truth["poses"]["surface_from_part"]) for truth in (stuck.at_end, stuck.at_sweep)))
    assert np.linalg.norm(moved[:3]) < 0.1e-3
    report = json.loads((stuck.folder / "report.json").read_text(encoding="utf-8"))
    assert report["part"] == "at the station" and report["end_state"]["arm"]["safety"] == "normal"


def test_a_grasp_that_was_seen_is_known_to_that_and_to_what_closing_moves() -> None:
    held = from_parts((0.001, -0.002, 0.17), pin.exp3(np.array([0.01, -0.02, 0.5])))
    seen = np.diag([30e-6**2, 40e-6**2, 20e-6**2, 0.3e-3**2, 0.1e-3**2, 0.2e-3**2])
    grasp = job_with_grasp(JOB, held, seen).grasp
    assert np.allclose(grasp.flange_from_part.se3().homogeneous, held.homogeneous, atol=1e-12)
    assert grasp.sigma == float(np.sqrt(40e-6**2 + GRIPPED[1, 1]))
    assert grasp.sigma_angle == float(np.sqrt(0.3e-3**2 + GRIPPED[3, 3])) and grasp.size == JOB.grasp.size
