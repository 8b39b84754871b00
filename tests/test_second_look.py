"""A surface that lies elsewhere than where it was swept is seen before the part is put down."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.devices.direct import VirtualCell
from cell.inversion.moved import SurfaceMotion
from cell.lab.bench.whole_job import JobRecord, NoFrames
from cell.steps.kinds import PLACE
from cell.steps.second_look import LINES, require_in_place, sparse
from drivers.errors import CellError, DeviceFault, LimitError, RefusedError
from statemachine.runner import StepContext
from tests.report_runs import CONFIG, at_station, pot, work_of


def slid(cell: VirtualCell, shift: tuple[float, float], turn: float) -> None:
    """Push the surface over its table, m and rad; the board stays."""
    world = cell.world
    pose = world.scene.world_from_surface.copy()
    c, s = math.cos(turn), math.sin(turn)
    pose[:3, :3] = pose[:3, :3] @ [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    pose[:2, 3] += shift
    world.scene = replace(world.scene, world_from_surface=pose)
    world._cameras.show(world.scene, world.station)


def looked(
    record: JobRecord,
    folder: Path,
    shift: tuple[float, float] = (0.0, 0.0),
    turn: float = 0.0,
    further: float = 0.0,
    cell: VirtualCell | None = None,
) -> SurfaceMotion:
    """A look at the surface of `record`, slid by so much, from a vehicle so many metres from where it stood."""
    job, nominal = pot()
    cell = cell or VirtualCell(CONFIG, record.seed, record.level)
    at_station(cell, record, further)
    cell.devices.vehicle.brake()
    slid(cell, shift, turn)
    work = work_of(cell, job, nominal, record, NoFrames(), folder)
    cell.devices.interlocks.work_with(work.calibration.configuration)
    made = [record.results[name] for name in ("board_photo", "laser_sweep", "reconstruct", "invert_pose")]
    context = StepContext(PLACE.policy().of("place"), 1, math.inf, {}, cell.clock, lambda event: None)
    return require_in_place(work, *made, context)


def test_one_that_lies_where_it_lay_is_told_so(placed_pot: JobRecord, tmp_path: Path) -> None:
    found = looked(placed_pot, tmp_path)
    assert np.linalg.norm(found.motion[:3]) < 0.2e-3 and np.linalg.norm(found.motion[3:]) < 0.5e-3
    assert not found.moved and found.times < 0.9
    assert found.matched == pytest.approx(1.0, abs=0.1)
    # What the run itself saw is in its journal.
    result = placed_pot.results["place"].summary()["surface_moved"]
    assert np.abs(result["mm"]).max() < 0.2 and np.abs(result["mrad"]).max() < 0.5


@pytest.mark.parametrize(
    ("shift", "turn", "further"),
    [((0.5e-3, 0.0), 0.0, 0.0), ((0.0, -0.5e-3), 0.0, 0.0), ((0.0, 0.0), 3e-3, 0.0), ((0.0, 0.0), 0.0, 0.5e-3)],
    ids=["along", "across", "turned", "the vehicle was pushed"],
)
def test_one_that_slid_over_its_table_is_refused(
    placed_pot: JobRecord, tmp_path: Path, shift: tuple[float, float], turn: float, further: float
) -> None:
    with pytest.raises(RefusedError, match=r"run the job again") as refused:
        looked(placed_pot, tmp_path, shift, turn, further)
    (told,) = re.findall(
        r"the surface has moved by (\d\.\d\d) mm and (\d\.\d\d\d) deg since it was swept", str(refused.value)
    )
    pushed = 1e3 * (math.hypot(*shift) + further)
    assert float(told[0]) == pytest.approx(pushed, abs=0.2)
    assert np.radians(float(told[1])) == pytest.approx(abs(turn), abs=0.6e-3)
    (number,) = refused.value.numbers
    assert number.value > number.most == 1.0


def test_one_that_is_not_there_any_more_is_refused(placed_pot: JobRecord, tmp_path: Path) -> None:
    with pytest.raises(RefusedError, match="does not lie any more where it was swept"):
        looked(placed_pot, tmp_path, (0.0, 0.045))


@pytest.mark.parametrize(
    "error",
    [
        LimitError("scan_camera", "30 Hz"),
        DeviceFault("scan_camera", "camera.setting", "it took 30 Hz", recoverable=False, hint=""),
    ],
    ids=["limit", "setting"],
)
def test_a_camera_of_a_few_frame_rates_takes_all_lines_again(
    placed_pot: JobRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: CellError
) -> None:
    cell = VirtualCell(CONFIG, placed_pot.seed, placed_pot.level)
    camera, rates = cell.scan_camera, []
    usual = camera.configure

    def configure(exposure: float, frame_rate: float) -> None:
        if frame_rate != 30.0:
            raise error
        rates.append(frame_rate)
        usual(exposure, frame_rate)

    monkeypatch.setattr(camera, "configure", configure)
    assert not looked(placed_pot, tmp_path, cell=cell).moved
    assert set(rates) == {30.0}


def test_a_second_look_takes_few_lines_of_one_strip() -> None:
    scan = pot()[0].scan
    few = sparse(scan)
    assert few.speed == scan.speed and len(few.swath) == 1
    assert few.length / few.speed * few.frame_rate == pytest.approx(LINES)
    slow = scan.model_copy(update={"frame_rate": 5.0, "speed": 0.02})
    assert sparse(slow).frame_rate == 5.0
