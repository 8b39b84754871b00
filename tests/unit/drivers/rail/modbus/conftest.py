"""A simulated Modbus drive."""

from collections.abc import Iterator

import pytest

from tests.support.modbus_maps import PATHS
from tests.support.wire.modbus_bench import Drive, config


@pytest.fixture
def drive() -> Iterator[Drive]:
    made = Drive.of(config(PATHS))
    yield made
    made.peer.stop()
