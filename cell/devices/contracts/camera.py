"""What the cell relies on in a camera."""

from __future__ import annotations

import numpy as np
import pytest

from cell.devices.contracts import Bench
from cell.devices.contracts.device import DeviceContract
from drivers.errors import InterlockError, LimitError
from drivers.interfaces import Camera

EXPOSURE_S, RATE_HZ = 0.005, 10.0
PATIENCE_S = 10.0


class CameraContract(DeviceContract):
    """A camera that takes 5 ms at 10 Hz."""

    def test_a_picture_began_after_it_was_asked_for(self, bench: Bench[Camera]) -> None:
        """8 bits in the camera's shape, exposed as configured, never a buffered one."""
        camera = bench.device
        camera.configure(EXPOSURE_S, RATE_HZ)
        last = -1
        for _ in range(3):
            asked = bench.clock.now()
            frame = camera.grab(PATIENCE_S)
            assert frame.image.shape == camera.shape
            assert frame.image.dtype == np.uint8
            assert frame.exposure == pytest.approx(EXPOSURE_S, rel=0.02)
            assert frame.host_time >= asked - camera.time_bound
            assert frame.mid_exposure == pytest.approx(frame.host_time + EXPOSURE_S / 2, abs=1e-4)
            assert frame.frame_id > last
            last = frame.frame_id

    def test_a_stream_comes_in_order_at_its_rate_and_knows_its_losses(self, bench: Bench[Camera]) -> None:
        """Ids count every exposure, and times are those of the exposures."""
        camera = bench.device
        camera.configure(EXPOSURE_S, RATE_HZ)
        with camera.stream() as frames:
            made = [frames.next(PATIENCE_S) for _ in range(6)]
            with pytest.raises(InterlockError):
                camera.grab(PATIENCE_S)
            with pytest.raises(InterlockError):
                camera.configure(EXPOSURE_S, RATE_HZ)
        ids = np.diff([frame.frame_id for frame in made])
        assert (ids >= 1).all()
        assert [frame.lost_before for frame in made[1:]] == list(ids - 1)
        assert np.diff([frame.host_time for frame in made]) / ids == pytest.approx(1.0 / RATE_HZ, rel=0.05)
        assert camera.grab(PATIENCE_S).frame_id > made[-1].frame_id

    def test_limits_are_kept_before_anything_is_sent(self, bench: Bench[Camera]) -> None:
        """`LimitError`, and the settings stay."""
        camera = bench.device
        camera.configure(EXPOSURE_S, RATE_HZ)
        for exposure, rate in ((1e-9, RATE_HZ), (1e4, RATE_HZ), (EXPOSURE_S, 1e6), (0.2, RATE_HZ)):
            with pytest.raises(LimitError):
                camera.configure(exposure, rate)
        assert camera.grab(PATIENCE_S).exposure == pytest.approx(EXPOSURE_S, rel=0.02)
