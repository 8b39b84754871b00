"""The vehicle on CANopen with its simulated drives, on a bus inside this process."""

from collections.abc import Iterator

import pytest

from tests.support.canopen_bench import Bench, at_bench


@pytest.fixture(scope="module")
def connected() -> Iterator[Bench]:
    """For all tests that leave drives behind which can be enabled again."""
    with at_bench() as made:
        yield made


@pytest.fixture
def bench(connected: Bench) -> Bench:
    connected.peer.clear()
    connected.vehicle.enable()
    return connected


@pytest.fixture
def apart() -> Iterator[Bench]:
    """Not connected yet."""
    made = Bench()
    try:
        yield made
    finally:
        made.peer.stop()
