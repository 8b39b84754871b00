"""An arm on a fixed frame: there is nothing to drive, and a station that stands elsewhere is refused with how far."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cell import Cell
from cell.check.fit import require_fit
from cell.check.place import way_problems
from cell.config.cell_config import default_toml, load_config
from cell.config.job import load_job
from cell.devices.assembly import connect_one
from cell.devices.contracts import Bench, DeviceContract
from cell.devices.diagnosis.diagnosis import _vehicle_state
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.drive.way import Whereabouts
from cell.procedures.steps.drive_to_target import stand_at_target
from drivers.clock import Clock
from drivers.errors import ConfigError, InterlockError, NotConnectedError, RefusedError
from drivers.interfaces import Vehicle
from drivers.vehicle.fixed import FixedVehicle
from tests.support.described_cells import described, pose

JOB = load_job("pot")[0]


class TestFixedVehicle(DeviceContract):
    """What every device promises."""

    @pytest.fixture
    def bench(self) -> Iterator[Bench[Vehicle]]:
        clock = Clock()
        yield Bench(lambda: FixedVehicle("vehicle", clock), clock)


def test_it_stands_braked_and_is_not_driven():
    vehicle: Vehicle = FixedVehicle("vehicle", Clock())
    vehicle.enable()
    state = vehicle.state()
    assert (state.braked, state.speed, state.emergency_stop, state.trouble) == (True, 0.0, False, ())
    vehicle.drive(0.0, 0.0)
    for velocity in ((0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.0, -0.1)):
        with pytest.raises(InterlockError, match=r'vehicle\.driver = "fixed".*Bring the station'):
            vehicle.drive(*velocity)
    vehicle.close()
    vehicle.stop()
    for asked in (vehicle.state, vehicle.check, vehicle.enable, vehicle.brake, lambda: vehicle.drive(0.0, 0.0)):
        with pytest.raises(NotConnectedError):
            asked()


def fixed_cell(folder: Path) -> Path:
    """The shipped configuration with no vehicle."""
    text = default_toml()
    begin, end = text.index("[vehicle]"), text.index("[scan_camera]")
    path = folder / "cell.toml"
    path.write_text(text[:begin] + '[vehicle]\ndriver = "fixed"\n\n' + text[end:])
    return path


def job_at(folder: Path, *, target_x: float = -1050.0, start_z: float = -600.0) -> Path:
    """The job `pot` with its target so far from the place, and its start so high, mm."""
    level = (0.0, 0.0, 0.0)
    approach = {"target": pose((target_x, 0.0, -600.0), level), "start": pose((-3050.0, 0.0, start_z), level)}
    return described(folder / f"{target_x:g} {start_z:g}", job={"approach": approach})[1]


def test_a_place_out_of_reach_is_refused_with_how_much_is_missing(tmp_path):
    """And start and staging, which nothing drives over, are not looked at."""
    config = load_config(fixed_cell(tmp_path))
    job, _ = load_job(job_at(tmp_path, start_z=-100.0))
    assert list(way_problems(job, config)) == []
    assert "they need one height" in next(way_problems(job, load_config(None)))
    far, mesh = load_job(job_at(tmp_path, target_x=-1800.0))
    with pytest.raises(ConfigError, match=r"out of reach; the nearest pose found stays \d+\.\d mm"):
        require_fit(far, config, mesh)


def test_in_a_simulated_cell_it_stands_still_where_the_job_has_it(tmp_path):
    config = load_config(fixed_cell(tmp_path))
    cell = VirtualCell(config, 3, "workshop", Described.of("pot"))
    assert cell.devices.vehicle.bare.identity().address == "fixed"
    x, y, yaw = cell.world.vehicle.planar(0.0)
    assert math.hypot(x + 1.05, y) < JOB.approach.tolerance
    assert abs(yaw) < JOB.approach.tolerance_angle
    stood = cell.world.world_from_base(0.0)
    cell.clock.sleep(0.63)
    assert np.array_equal(cell.world.world_from_base(0.63), stood)
    assert cell.truth()["vehicle"]["braked"]
    assert _vehicle_state(cell.devices.vehicle) == "braked, errors 0x0000"
    with pytest.raises(ConfigError, match="no vehicle that could have it"):
        cell.require_fault("vehicle.emergency_stop")


@pytest.mark.campaign
def test_a_whole_job_ends_placed_without_a_vehicle(calibrated_folder: Path):
    with Cell.open(fixed_cell(calibrated_folder), sim="all", clock="virtual", seed=2, job="pot") as opened:
        report = opened.run("pot").report
    assert (report["outcome"], report["end_state"]["collisions"]) == ("placed", [])
    assert report["truth"]["error_mm"]["d"]["mean"] / report["truth"]["bound_mm"] <= 1.5
    assert report["steps"][0]["result"]["driven"] is False


def test_a_configuration_names_it_with_nothing_else(tmp_path):
    config = load_config(fixed_cell(tmp_path))
    assert not config.vehicle.DRIVES
    assert config.calibration_hash() == load_config(None).calibration_hash()
    assert connect_one(config, "vehicle", Clock()).identity().model == "no vehicle, a fixed frame"


@pytest.mark.parametrize(("off", "refused"), [(0.0, False), (0.6, False), (1.5, True), (-1.5, True)])
def test_the_station_has_to_stand_where_the_job_has_it(off: float, refused: bool):
    """Moved along and across by `off` times the tolerance."""
    stand = load_config(None).arm.vehicle_from_base.se3()
    place_from_vehicle = JOB.approach.target.se3()
    shift = off * JOB.approach.tolerance
    place_from_vehicle.translation = place_from_vehicle.translation + np.array([shift, shift, 0.0])
    base_from_board = (place_from_vehicle * stand).inverse() * JOB.place_from_board
    fix = BoardFix(base_from_board, 1e-8 * np.eye(6), 0.1, 0.0, ())
    vehicle = FixedVehicle("vehicle", Clock())
    whereabouts = Whereabouts(vehicle)
    whereabouts.enter(JOB)
    if refused:
        with pytest.raises(RefusedError, match=r"fixed frame.*move the station") as met:
            stand_at_target(JOB, stand, vehicle, whereabouts, lambda: fix)
        assert [number.value for number in met.value.numbers[:2]] == pytest.approx([1e3 * shift] * 2)
        return
    arrival = stand_at_target(JOB, stand, vehicle, whereabouts, lambda: fix)
    assert math.hypot(arrival.error_along, arrival.error_across) == pytest.approx(
        math.sqrt(2) * off * JOB.approach.tolerance, abs=1e-6
    )
