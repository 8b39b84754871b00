"""Promises of `sim_backends.models.camera`."""

import pytest

from sim_backends.models.camera import CameraSpec, CameraState

SPEC = CameraSpec("SimCam", "SIM1", 64, 48, frame_rate_max=30.0, epoch=5000.0, drift_ppm=80.0)


def test_ids_count_lost_exposures_too():
    camera = CameraState(SPEC)
    camera.fault("camera.frame_loss", 2)
    assert [camera.expose() for _ in range(4)] == [(1, True), (2, True), (3, False), (4, False)]
    assert camera.next_frame_id == 5
    camera.fault("camera.silent", 1)
    assert camera.silent
    camera.clear()
    assert not camera.silent
    with pytest.raises(ValueError, match=r"camera\.frame_loss"):
        camera.fault("camera.explode", 1)


def test_the_devices_clock_drifts_from_its_epoch_and_settings_begin_in_range():
    assert SPEC.device_ns(0.0) == 5000 * 10**9
    assert SPEC.device_ns(100.0) - SPEC.device_ns(0.0) == pytest.approx(100.0 * (1 + 80e-6) * 1e9, abs=1)
    slow = CameraState(CameraSpec("SimCam", "SIM1", 64, 48, frame_rate_max=5.0, exposure_min=0.01))
    assert (slow.exposure, slow.frame_rate) == (0.01, 5.0)
