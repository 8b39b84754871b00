"""The cameras in this process keep a camera's promises."""

import pytest

from drivers.errors import DeadlineError
from tests.support.simulator.virtual_devices import ideal_cell


def test_a_silent_camera_is_a_deadline_and_a_lost_frame_is_counted():
    made = ideal_cell()
    camera = made.scan_camera
    camera.configure(0.002, 50.0)
    with camera.stream() as frames:
        first = frames.next(1.0)
        made.fault("camera.frame_loss")
        second = frames.next(1.0)
        assert (second.frame_id - first.frame_id, second.lost_before, frames.lost) == (2, 1, 1)
        made.fault("camera.silent")
        begun = made.clock.now()
        with pytest.raises(DeadlineError):
            frames.next(1.0)
        assert made.clock.now() - begun == pytest.approx(1.0, abs=0.05)
    with pytest.raises(DeadlineError):
        camera.grab()
