"""A simulated camera on GigE Vision."""

import threading
from collections.abc import Iterator

import pytest

from tests.support.wire.gige_bench import Bench, served


@pytest.fixture
def bench() -> Iterator[Bench]:
    with served() as made:
        yield made
    assert not [thread for thread in threading.enumerate() if thread.name == "scan_camera pictures"]
