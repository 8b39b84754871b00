"""The driver's way for USB3 Vision, with the contract of cameras, at the camera that Aravis has in its own process.

No such camera is here, and none can be put on a loopback: what is tested is everything but the USB transport itself:
the library's device without addresses, heartbeat and resends, its stream, features, stamps.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Any

import pytest

from cell.devices.contracts import Bench, CameraContract
from drivers.camera.genicam.aravis import LIBRARIES, Aravis
from drivers.camera.genicam.camera import GenicamCamera, GenicamSetup, Region
from drivers.clock import Clock
from drivers.interfaces import Camera
from tests.support.wire.gige_bench import require_aravis

pytestmark = pytest.mark.wire


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
        clock = Clock()
        made: Bench[Camera] = Bench(
            lambda: GenicamCamera("scan_camera", InProcess(), GenicamSetup(Region(512, 512)), clock=clock), clock
        )
        yield made
        made.over()
