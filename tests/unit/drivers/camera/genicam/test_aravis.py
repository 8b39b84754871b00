"""The contract of cameras at the two that Aravis simulates itself: one on GigE Vision, one in its own process.

The latter stands for USB3 Vision: everything but the USB transport itself is tested, without addresses, heartbeat and
resends."""

import ctypes
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from cell.devices.contracts import Bench, CameraContract
from cell.devices.contracts.device import EXPOSURE_S, RATE_HZ, TIMEOUT_S
from drivers.camera.genicam.aravis import LIBRARIES, Aravis
from drivers.camera.genicam.camera import GenicamCamera
from drivers.camera.genicam.make import GenicamConfig
from drivers.clock import Clock
from drivers.interfaces import Camera
from tests.support.wire.aravis_fake import fake_camera, opened
from tests.support.wire.gige_bench import require_aravis

# This camera sends a picture in one burst and sends nothing again: what the receiver is too late for is lost.
pytestmark = pytest.mark.wire


PICTURE = (np.arange(480 * 640) % 251).astype(np.uint8).reshape(480, 640)
"""No pixel has the grey of its neighbours."""


class TestContract(CameraContract):
    """What the cell relies on in any camera."""

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Iterator[Bench[Camera]]:
        with fake_camera(lambda exposure: PICTURE) as host:
            clock = Clock()
            made: Bench[Camera] = Bench(lambda: opened(host, clock), clock)
            yield made
            made.over()

    def test_a_stream_comes_in_order_at_its_rate_and_knows_its_losses(self, bench: Bench[Camera]):
        """Its first picture comes at once, off its grid, and the others as well as it is run: it has no other clock."""
        camera = bench.device
        camera.configure(EXPOSURE_S, RATE_HZ)
        with camera.stream() as frames:
            frames.next(TIMEOUT_S)
            made = [frames.next(TIMEOUT_S) for _ in range(5)]
        ids = np.diff([frame.frame_id for frame in made])
        assert [frame.lost_before for frame in made[1:]] == list(ids - 1)
        # A tick that a busy machine has it miss is no exposure, and it counts none.
        periods = RATE_HZ * np.diff([frame.host_time for frame in made]) / ids
        assert np.median(periods) == pytest.approx(1.0, abs=0.2)
        assert periods.min() > 0.5 and periods.max() < 2.5
        assert [frame.received for frame in made] == sorted(frame.received for frame in made)

    def test_a_trigger_tells_the_time_of_a_picture_that_comes_unchanged(self, bench: Bench[Camera]):
        """Its clock has no latch: the exposure lay between the trigger and the picture, and that bounds the time."""
        camera = bench.device
        camera.configure(EXPOSURE_S, RATE_HZ)
        called = bench.clock.now()
        frame = camera.grab(TIMEOUT_S)
        assert (frame.image == PICTURE).all()
        assert 0.0 < camera.time_bound <= 0.5 * (frame.received - frame.exposure - called) + 1e-3
        assert called <= frame.host_time <= frame.received - frame.exposure


class InProcess:
    """Where Aravis' own camera is: as `UsbPlace`, nobody else can hold it."""

    control, text, absent = False, "the library's own camera", "see that the library is whole"

    def open(self, library: Aravis) -> Any:
        make = ctypes.CDLL(LIBRARIES[0]).arv_fake_device_new
        make.restype, make.argtypes = ctypes.c_void_p, [ctypes.c_char_p, ctypes.c_void_p]
        return make(b"TEST0", None)


class TestUsb3(CameraContract):
    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Iterator[Bench[Camera]]:
        require_aravis()
        clock, record = Clock(), GenicamConfig.model_construct(width=512, height=512)
        made: Bench[Camera] = Bench(lambda: GenicamCamera("scan_camera", InProcess(), record, clock=clock), clock)
        yield made
        made.over()
