"""A rendered scene over GigE Vision, through a camera and a library that were not written here."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.clock import Clock
from drivers.errors import DeviceFault
from sim_backends.world.world import World
from tests.support.wire.aravis_fake import fake_camera, opened

# Aravis' camera sends a picture in one burst and sends nothing again: what the receiver is too late for is lost.
pytestmark = pytest.mark.wire


def test_a_rendered_scene_comes_unchanged_and_a_trigger_tells_the_time() -> None:
    world = World(7, "ideal", 1.0)
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
