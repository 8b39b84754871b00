"""A vehicle or a station that has moved since the board was photographed is seen before the part is put down."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.devices.simulated.direct import VirtualCell
from cell.measure.inversion import PlacePose
from cell.procedures.drive.station_check import require_unmoved
from cell.procedures.steps.kinds import PLACE
from cell.procedures.steps.place import STEP
from drivers.errors import RefusedError
from lab.bench.job.whole_job import JobRecord, NoFrames
from statemachine.runner import StepContext
from tests.support.report_runs import CONFIG, at_station, pot, work_of


def looked(record: JobRecord, further: float, folder: Path) -> str:
    """The refusal of a look at the board with the vehicle so many metres from where it stood; "" for none."""
    job, nominal = pot()
    cell = VirtualCell(CONFIG, record.seed, record.level)
    at_station(cell, record, further)
    cell.devices.vehicle.brake()
    work = work_of(cell, job, nominal, record, NoFrames(), folder)
    try:
        require_unmoved(work, record.results["board_photo"], "before the sweep", lambda share, text: None)
    except RefusedError as refused:
        assert refused.numbers[0].name == "board moved by"
        return str(refused)
    return ""


@pytest.mark.parametrize("further", [0.0, 1.0e-3])
def test_a_vehicle_that_was_pushed_after_the_photograph_is_refused(
    placed_pot: JobRecord, tmp_path: Path, further: float
) -> None:
    said = looked(placed_pot, further, tmp_path)
    if not further:
        assert said == ""
        return
    (shift,) = re.findall(r"the board has moved by (\d\.\d\d) mm .* before the sweep.*run the job again", said)
    assert float(shift) == pytest.approx(1.0, abs=0.3)


def test_where_the_board_alone_decides_it_is_looked_at_again_before_the_part_goes_down(
    placed_pot: JobRecord, tmp_path: Path
) -> None:
    """The surface does not tell: round, it lies the same however it was turned, and where the board has gone."""
    job, nominal = pot()
    cell = VirtualCell(CONFIG, placed_pot.seed, placed_pot.level)
    at_station(cell, placed_pot, 0.0)
    cell.devices.vehicle.brake()
    world = cell.world
    pose = world.scene.world_from_board.copy()
    pose[0, 3] += 1e-3
    world.scene = replace(world.scene, world_from_board=pose)
    world._cameras.show(world.scene, world.station)
    work = work_of(cell, job, nominal, placed_pot, NoFrames(), tmp_path)
    cell.devices.interlocks.work_with(work.calibration.configuration)
    seen: PlacePose = placed_pot.results["invert_pose"]
    turned = replace(seen, verdict=replace(seen.verdict, unseen=("rotation about the z axis",)))
    results = {name: placed_pot.results[name] for name in ("board_photo", "laser_sweep", "reconstruct")}
    context = StepContext(
        PLACE.policy().of("place"), 1, math.inf, {**results, "invert_pose": turned}, cell.clock, lambda event: None
    )
    with pytest.raises(RefusedError, match="the board has moved by"):
        STEP.work(work, context)
    assert cell.world.part.held


def test_what_the_cameras_mounting_is_off_by_does_not_hide_it(placed_pot: JobRecord) -> None:
    fix = placed_pot.results["board_photo"]
    # Part of what is stated of the board, and no more than that.
    assert np.linalg.eigvalsh(fix.by_mount).min() > -1e-12
    assert np.linalg.eigvalsh(fix.covariance - fix.by_mount).min() > -1e-12
    assert np.trace(fix.by_mount) > 0.0
