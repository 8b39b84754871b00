"""Promises of `drivers.camera.v4l2`."""

import numpy as np
import pytest

from drivers.camera.v4l2 import ExposureTiming, to_grey


def test_what_a_driver_hands_over_becomes_grey():
    grey = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
    yuyv = np.stack([grey, np.full_like(grey, 128)], axis=2)
    bgr = np.repeat(grey[:, :, None], 3, axis=2)
    for raw in (grey, grey.reshape(1, -1), yuyv, bgr):
        assert (to_grey(raw, (48, 64)) == grey).all()
    for wrong in (None, grey.astype(np.uint16), grey[:40]):
        with pytest.raises(ValueError):
            to_grey(wrong, (48, 64))


def test_a_uvc_stamp_leaves_a_frame_and_the_exposure_open():
    assert ExposureTiming(0.02, 10.0).open_s == pytest.approx(0.12)
