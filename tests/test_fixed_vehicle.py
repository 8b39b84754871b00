"""An arm on a fixed frame: there is nothing to drive, and a station that stands elsewhere is refused with how far."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cell.config import default_toml, load_config
from cell.devices.assembly import connect_one
from cell.devices.contracts import Bench
from cell.devices.contracts.device import DeviceContract
from cell.job import load_job
from cell.steps.drive_to_target import stand_at_target
from cell.steps.photograph import BoardFix
from cell.steps.whereabouts import Whereabouts
from drivers.clock import Clock
from drivers.errors import InterlockError, RefusedError
from drivers.interfaces import Vehicle
from drivers.vehicle.fixed import FixedVehicle

JOB = load_job("pot")[0]


class TestFixedVehicle(DeviceContract):
    """What every device promises."""

    @pytest.fixture
    def bench(self) -> Iterator[Bench[Vehicle]]:
        clock = Clock()
        yield Bench(lambda: FixedVehicle("vehicle", clock), clock)


def test_it_stands_braked_and_is_not_driven() -> None:
    vehicle: Vehicle = FixedVehicle("vehicle", Clock())
    vehicle.enable()
    state = vehicle.state()
    assert (state.braked, state.speed, state.emergency_stop, state.trouble) == (True, 0.0, False, ())
    vehicle.drive(0.0, 0.0)
    with pytest.raises(InterlockError, match=r'vehicle\.driver = "fixed".*Bring the station'):
        vehicle.drive(0.1, 0.0)


def test_a_configuration_names_it_with_nothing_else(tmp_path: Path) -> None:
    text = default_toml()
    begin, end = text.index("[vehicle]"), text.index("[scan_camera]")
    path = tmp_path / "cell.toml"
    path.write_text(text[:begin] + '[vehicle]\ndriver = "fixed"\n\n' + text[end:])
    config = load_config(path)
    assert not config.vehicle.DRIVES
    assert config.calibration_hash() == load_config(None).calibration_hash()
    assert connect_one(config, "vehicle", Clock()).identity().model == "no vehicle, a fixed frame"


@pytest.mark.parametrize(("off", "refused"), [(0.0, False), (0.6, False), (1.5, True)])
def test_the_station_has_to_stand_where_the_job_has_it(off: float, refused: bool) -> None:
    """Moved along and across by `off` times the tolerance."""
    stand = load_config(None).arm.vehicle_from_base.se3()
    place_from_vehicle = JOB.approach.target.se3()
    shift = off * JOB.approach.tolerance
    place_from_vehicle.translation = place_from_vehicle.translation + np.array([shift, -shift, 0.0])
    base_from_board = (place_from_vehicle * stand).inverse() * JOB.place_from_board
    fix = BoardFix(base_from_board, 1e-8 * np.eye(6), 0.1, 0.0, ())
    vehicle = FixedVehicle("vehicle", Clock())
    whereabouts = Whereabouts(vehicle)
    whereabouts.enter(JOB)
    if refused:
        with pytest.raises(RefusedError, match=r"fixed frame.*move the station") as met:
            stand_at_target(JOB, stand, vehicle, whereabouts, lambda: fix)
        assert met.value.numbers[0].value == pytest.approx(1.5e3 * JOB.approach.tolerance)
        return
    arrival = stand_at_target(JOB, stand, vehicle, whereabouts, lambda: fix)
    assert math.hypot(arrival.error_along, arrival.error_across) == pytest.approx(
        math.sqrt(2) * off * JOB.approach.tolerance, abs=1e-6
    )
