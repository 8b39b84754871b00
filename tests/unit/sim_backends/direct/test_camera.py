"""The cameras in this process keep a camera's promises."""

import pytest

from drivers.errors import DeadlineError


def test_a_silent_camera_is_a_deadline_and_a_lost_frame_is_counted(fresh):
    camera = fresh.scan_camera
    camera.configure(0.002, 50.0)
    with camera.stream() as frames:
        first = frames.next(1.0)
        fresh.fault("camera.frame_loss")
        second = frames.next(1.0)
        assert (second.frame_id - first.frame_id, second.lost_before, frames.lost) == (2, 1, 1)
        fresh.fault("camera.silent")
        begun = fresh.clock.now()
        with pytest.raises(DeadlineError):
            frames.next(1.0)
        assert fresh.clock.now() - begun == pytest.approx(1.0, abs=0.05)
    with pytest.raises(DeadlineError):
        camera.grab()
