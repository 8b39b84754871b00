"""A simulated GigE Vision camera whose pictures carry the world time that they show, and its driver."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.camera.genicam.aravis import AravisMissing, load
from drivers.camera.genicam.camera import GenicamCamera
from drivers.camera.genicam.device import GigePlace
from drivers.camera.genicam.make import GigeCameraConfig
from drivers.clock import Clock
from drivers.interfaces import Frame
from sim_backends.clock import WorldClock
from sim_backends.models.camera import CameraSpec
from sim_backends.peers.camera.gige import GigePeer
from tests.support.wire.clocks import ahead

SPEED = 3.0
SPEC = CameraSpec("SimCam", "SIM000007-SCAN", 64, 48, frame_rate_max=120.0, epoch=5000.0, drift_ppm=60.0)


def opened(host: str, clock: Clock, *, look: bool = False, **changed: Any) -> GenicamCamera:
    """The driver of the camera at `host`, whose record has these values instead of the usual ones."""
    record = GigeCameraConfig.model_construct(**{"width": 64, "height": 48, **changed})
    return GenicamCamera("scan_camera", GigePlace(host), record, clock=clock, look=look)


def require_aravis() -> None:
    """Skip where the library is not installed, with what would install it."""
    try:
        load()
    except AravisMissing as missing:
        pytest.skip(str(missing))


def render(t_mid: float, exposure: float) -> NDArray[np.uint8]:
    """Grey 100 with the time in the first eight pixels, and bright in the last."""
    image = np.full((48, 64), 100, np.uint8)
    image[0, :8] = np.frombuffer(np.float64(t_mid).tobytes(), np.uint8)
    image[47, 63] = 200
    return image


@dataclass
class Bench:
    """A camera on its wire, and the world that it shows."""

    peer: GigePeer
    world: WorldClock
    clock: Clock

    def open(self, *, look: bool = False, **changed: Any) -> GenicamCamera:
        """The driver, connected, its record `changed` so."""
        return opened(self.peer.address, self.clock, look=look, **changed)

    def shown(self, frame: Frame) -> float:
        """Host time that the picture shows."""
        world = float(np.frombuffer(frame.image[0, :8].tobytes(), np.float64)[0])
        return world + ahead(self.clock, self.world)


@contextmanager
def served(spec: CameraSpec = SPEC) -> Iterator[Bench]:
    """The camera, served on a loopback address of its own."""
    require_aravis()
    world = WorldClock(SPEED)
    peer = GigePeer("scan_camera", world, render, spec)
    peer.start()
    try:
        yield Bench(peer, world, Clock(SPEED))
    finally:
        peer.stop()
