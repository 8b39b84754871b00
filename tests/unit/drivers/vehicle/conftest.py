"""The AgileX vehicle on its bus, and the same enabled."""

from collections.abc import Iterator

import pytest

from tests.support.wire.vehicle_bench import SPEED, Bench, benched


@pytest.fixture
def bench() -> Iterator[Bench]:
    with benched(SPEED) as made:
        yield made


@pytest.fixture
def enabled(bench: Bench) -> Bench:
    bench.vehicle.enable()
    return bench
