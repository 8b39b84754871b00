"""The GenICam driver against a camera that was not written here: Aravis' simulated one, showing our rendered scenes."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from cell.devices.contracts import Bench
from cell.devices.contracts.camera import EXPOSURE_S, PATIENCE_S, RATE_HZ, CameraContract
from drivers.camera.genicam.camera import GenicamCamera, Setup
from drivers.camera.genicam.device import GigePlace
from drivers.camera.genicam.settings import Region
from drivers.clock import Clock
from drivers.errors import DeviceFault
from drivers.interfaces import Camera
from sim_backends.world.world import World
from tests.wire.aravis_fake import fake_camera

pytestmark = pytest.mark.wire

VGA = Region(640, 480)


def opened(host: str, clock: Clock) -> GenicamCamera:
    return GenicamCamera("scan_camera", GigePlace(host), Setup(VGA), clock=clock)


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
        """But for its first picture, which it sends at once and not at its rate."""
        camera = bench.device
        camera.configure(EXPOSURE_S, RATE_HZ)
        with camera.stream() as frames:
            frames.next(PATIENCE_S)
            made = [frames.next(PATIENCE_S) for _ in range(5)]
        ids = np.diff([frame.frame_id for frame in made])
        assert [frame.lost_before for frame in made[1:]] == list(ids - 1)
        assert np.diff([frame.host_time for frame in made]) / ids == pytest.approx(1.0 / RATE_HZ, rel=0.05)


def test_a_rendered_scene_comes_unchanged_and_a_trigger_tells_the_time() -> None:
    world = World(7, "ideal", 1.0, "pot")
    world.warm_up()
    scene = world.render("scan", 0.0, 0.005)
    assert len(np.unique(scene)) > 4, "the same grey everywhere would not show whether pixels stay in their places"
    clock = Clock()
    with fake_camera(lambda exposure: scene) as host:
        camera = opened(host, clock)
        assert camera.identity().serial
        assert math.isinf(camera.time_bound)
        camera.configure(0.005, 10.0)
        called = clock.now()
        frame = camera.grab(5.0)
        assert (frame.image == scene).all()
        # Its clock has no latch: the exposure lay between the trigger and the picture, and that bounds the time.
        assert 0.0 < camera.time_bound <= 0.5 * (frame.received - frame.exposure - called) + 1e-3
        assert called <= frame.host_time <= frame.received - frame.exposure
        with pytest.raises(DeviceFault, match="another application holds the camera"):
            opened(host, clock)
        camera.close()
