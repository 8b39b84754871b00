"""The vehicle in this process keeps a vehicle's promises."""

import numpy as np
import pytest

from drivers.errors import InterlockError


def test_the_vehicle_counts_the_way_that_it_drove(cell):
    vehicle = cell.vehicle
    vehicle.enable()
    before, there = vehicle.state(), cell.world.vehicle.planar(cell.clock.now())
    for _ in range(25):
        vehicle.drive(0.2, 0.0)
        cell.clock.sleep(0.04)
    vehicle.brake()
    after, here = vehicle.state(), cell.world.vehicle.planar(cell.clock.now())
    assert np.hypot(after.x - before.x, after.y - before.y) == pytest.approx(
        np.hypot(here[0] - there[0], here[1] - there[1]), abs=2e-3
    )
    assert after.braked
    assert after.speed == 0.0
    with pytest.raises(InterlockError):
        vehicle.drive(0.1, 0.0)
