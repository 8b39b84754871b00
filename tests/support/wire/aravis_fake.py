"""Aravis' own simulated GigE Vision camera, filled by a function of ours: a peer that was not written here.

It answers on 127.0.0.1 alone, keeps the wall's time, has no latch of its clock and sends no packet again.
"""

import ctypes
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes import c_char_p, c_double, c_int, c_size_t, c_uint32, c_void_p

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.camera.genicam.aravis import LIBRARIES
from drivers.camera.genicam.camera import GenicamCamera
from drivers.clock import Clock
from tests.support.wire import gige_bench
from tests.support.wire.gige_bench import require_aravis

HOST = "127.0.0.1"
TRIGGERS_HZ = 100.0
"""How often it looks whether it was triggered."""
_FILL = ctypes.CFUNCTYPE(None, c_void_p, c_void_p, c_uint32, c_uint32, c_uint32)


@contextmanager
def fake_camera(picture: Callable[[float], NDArray[np.uint8]], serial: str = "GV77") -> Iterator[str]:
    """The camera's address; `picture(exposure in s)` is called when the exposure is over."""
    require_aravis()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((HOST, 3956))
        except OSError:
            pytest.skip(f"UDP port 3956 of {HOST} is taken: end the other simulated camera")
    library = next(found for found in map(_loaded, LIBRARIES) if found is not None)
    functions: dict[str, tuple[object, list[object]]] = {
        "arv_gv_fake_camera_new": (c_void_p, [c_char_p, c_char_p]),
        "arv_gv_fake_camera_is_running": (c_int, [c_void_p]),
        "arv_gv_fake_camera_get_fake_camera": (c_void_p, [c_void_p]),
        "arv_fake_camera_set_fill_pattern": (None, [c_void_p, _FILL, c_void_p]),
        "arv_fake_camera_set_trigger_frequency": (None, [c_void_p, c_double]),
        "arv_buffer_get_data": (c_void_p, [c_void_p, ctypes.POINTER(c_size_t)]),
        "g_object_unref": (None, [c_void_p]),
    }
    for name, (result, arguments) in functions.items():
        getattr(library, name).restype = result
        getattr(library, name).argtypes = arguments

    def fill(buffer: int, _data: int, exposure_us: int, _gain: int, _format: int) -> None:
        time.sleep(1e-6 * exposure_us)
        image = picture(1e-6 * exposure_us)
        # The buffer is as large as the picture that was asked for; what it says of its size is still nothing.
        ctypes.memmove(library.arv_buffer_get_data(buffer, ctypes.byref(c_size_t())), image.tobytes(), image.size)

    kept = _FILL(fill)
    camera = library.arv_gv_fake_camera_new(HOST.encode(), serial.encode())
    try:
        assert library.arv_gv_fake_camera_is_running(camera)
        inner = library.arv_gv_fake_camera_get_fake_camera(camera)
        library.arv_fake_camera_set_fill_pattern(inner, kept, None)
        library.arv_fake_camera_set_trigger_frequency(inner, TRIGGERS_HZ)
        yield HOST
    finally:
        library.g_object_unref(camera)


def opened(host: str, clock: Clock) -> GenicamCamera:
    """The driver on it, set to 640 x 480 pixels; what the camera sends in one go is not cut short on a busy machine."""
    return gige_bench.opened(host, clock, width=640, height=480, packet_size=8000, retention=2.0)


def _loaded(name: str) -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(name)
    except OSError:
        return None
