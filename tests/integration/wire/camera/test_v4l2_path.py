"""The driver for V4L2 cameras with the contract of cameras, at a video device that is made believe.

No camera and no kernel module is needed: `video_device.c` answers the calls by which OpenCV speaks to the kernel; it is
loaded before the C library of a process of its own. What a real camera's firmware does otherwise is not tested.
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from cell.devices.contracts import Bench, CameraContract
from drivers.camera.v4l2 import V4l2Camera
from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceFault, LimitError, NotConnectedError
from drivers.interfaces import Camera

pytestmark = pytest.mark.wire
DEVICE, LOADED = "/dev/video77", "CELL_VIDEO_DEVICE"
inside = pytest.mark.skipif(LOADED not in os.environ, reason="only in the process that has the video device")


@pytest.mark.campaign
def test_the_contract_holds_at_a_video_device_that_the_c_library_makes_believe(tmp_path):
    if (compiler := shutil.which("cc")) is None or LOADED in os.environ:
        pytest.skip("no C compiler is here, or this is the process that has the device")
    library = tmp_path / "video_device.so"
    source = Path(__file__).with_name("video_device.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"], check=True)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-n0", "-q", "-p", "no:cacheprovider", "-m", "not campaign", __file__],
        env={**os.environ, "LD_PRELOAD": str(library), LOADED: "1"}, capture_output=True, text=True, timeout=120.0,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:]
    assert "skipped" not in done.stdout.splitlines()[-1]


def camera(shape: tuple[int, int] = (480, 640), **options: object) -> V4l2Camera:
    return V4l2Camera("scan_camera", DEVICE, clock=Clock(), shape=shape, **options)  # type: ignore[arg-type]


@inside
class TestV4l2(CameraContract):
    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Iterator[Bench[Camera]]:
        made: Bench[Camera] = Bench(camera, Clock())
        yield made
        made.over()


@inside
def test_a_pictures_time_is_that_of_its_exposure_within_the_bound_that_is_stated():
    with closing(camera(gain=20.0)) as device:
        device.configure(0.010, 25.0)
        for _ in range(4):
            frame = device.grab()
            began = float(np.frombuffer(frame.image[0, :8].tobytes(), np.float64)[0])
            host = device._clock.now() - (time.monotonic() - began)
            assert abs(frame.host_time - host) <= device.time_bound
            assert frame.image[10, 10] == 100


@inside
def test_what_it_does_not_have_is_refused_by_name():
    with pytest.raises(ConfigError, match="gives 640x480 pixels, configured are 1280x1024"):
        camera((1024, 1280))
    with pytest.raises(DeviceFault, match="took pixel format 'YUYV' instead of 'MJPG'"):
        camera(fourcc="MJPG")
    with pytest.raises(DeviceFault, match="took gain 100 instead of 500"):
        camera(gain=500.0)
    with pytest.raises(NotConnectedError, match="fuser -v /dev/video78"):
        V4l2Camera("scan_camera", "/dev/video78", clock=Clock(), shape=(480, 640))
    with closing(camera()) as device:
        with pytest.raises(NotConnectedError, match="no other program uses it"):
            camera()
        with pytest.raises(DeviceFault, match="took frame rate 60 Hz instead of 90 Hz"):
            device.configure(0.005, 90.0)
        with pytest.raises(LimitError):
            device.configure(0.02, 60.0)
