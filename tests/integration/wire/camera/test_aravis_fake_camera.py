"""The GenICam driver against a camera that was not written here: Aravis' simulated one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from cell.devices.contracts import Bench
from cell.devices.contracts.device import EXPOSURE_S, PATIENCE_S, RATE_HZ, CameraContract
from drivers.clock import Clock
from drivers.interfaces import Camera
from tests.support.wire.aravis_fake import fake_camera, opened

# This camera sends a picture in one burst and sends nothing again: what the receiver is too late for is lost.
pytestmark = pytest.mark.wire


class TestContract(CameraContract):
    """What the cell relies on in any camera."""

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Iterator[Bench[Camera]]:
        grey = np.full((480, 640), 90, np.uint8)
        with fake_camera(lambda exposure: grey) as host:
            clock = Clock()
            made: Bench[Camera] = Bench(lambda: opened(host, clock), clock)
            yield made
            made.over()

    def test_a_stream_comes_in_order_at_its_rate_and_knows_its_losses(self, bench: Bench[Camera]) -> None:
        """Its first picture comes at once, off its grid, and the others as well as it is run: it has no other clock."""
        camera = bench.device
        camera.configure(EXPOSURE_S, RATE_HZ)
        with camera.stream() as frames:
            frames.next(PATIENCE_S)
            made = [frames.next(PATIENCE_S) for _ in range(5)]
        ids = np.diff([frame.frame_id for frame in made])
        assert [frame.lost_before for frame in made[1:]] == list(ids - 1)
        # A tick that a busy machine has it miss is no exposure, and it counts none.
        periods = RATE_HZ * np.diff([frame.host_time for frame in made]) / ids
        assert np.median(periods) == pytest.approx(1.0, abs=0.2)
        assert periods.min() > 0.5 and periods.max() < 2.5
        assert [frame.received for frame in made] == sorted(frame.received for frame in made)
