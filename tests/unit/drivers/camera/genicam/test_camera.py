"""The GenICam driver over real GigE Vision: Aravis on one side, the simulated camera on the other, loopback between."""

import numpy as np
import pytest

from drivers.errors import DeadlineError, DeviceFault, LimitError
from tests.support.wire.gige_bench import Bench

pytestmark = pytest.mark.wire


def test_times_are_those_that_the_pictures_show(bench: Bench):
    camera = bench.open()
    camera.configure(0.004, 50.0)
    called = bench.clock.now()
    frame = camera.grab()
    assert bench.shown(frame) > called
    with camera.stream() as frames:
        made = [frames.next(5.0) for _ in range(20)]
    camera.close()
    assert camera.time_bound < 0.003
    for each in (frame, *made):
        assert each.mid_exposure == pytest.approx(bench.shown(each), abs=camera.time_bound + 1e-4)
    assert np.diff([frame.host_time for frame in made]) == pytest.approx(np.full(19, 0.02), abs=1e-5)


def test_region_gain_and_packet_size_are_set(bench: Bench):
    camera = bench.open(width=32, height=16, offset=(32, 32), gain=6.0206, packet_size=576)
    camera.configure(0.004, 50.0)
    image = camera.grab().image
    camera.close()
    assert image.shape == (16, 32)
    assert (image[0, 0], image[15, 31]) == (200, 255)


def test_what_the_camera_has_not_is_refused_with_what_it_has(bench: Bench):
    with pytest.raises(LimitError, match=r"Width 80 is none .*allowed: 16 to 64 in steps of 1"):
        bench.open(width=80)
    with pytest.raises(LimitError, match="OffsetX 80 is none"):
        bench.open(width=32, height=16, offset=(80, 0))
    with pytest.raises(DeviceFault, match="no PixelFormat Mono16, it stays Mono8"):
        bench.open(pixel_format="Mono16")
    with pytest.raises(LimitError, match="gain 90"):
        bench.open(gain=90.0)
    bench.open().close()


def test_a_line_triggers_streams_and_photographs(bench: Bench):
    camera = bench.open(trigger="line")
    camera.configure(0.004, 50.0)
    with camera.stream() as frames:
        with pytest.raises(DeadlineError):
            frames.next(0.3)
        bench.peer.pulse()
        first = frames.next(5.0)
        bench.peer.pulse()
        assert frames.next(5.0).frame_id == first.frame_id + 1
    camera.close()


def test_a_photograph_can_come_from_a_free_run(bench: Bench):
    camera = bench.open(trigger="free")
    camera.configure(0.004, 20.0)
    called = bench.clock.now()
    assert bench.shown(camera.grab()) > called
    camera.close()


def test_a_free_run_whose_stamps_lie_before_every_question_ends_in_time(bench: Bench, monkeypatch):
    camera = bench.open(trigger="free")
    camera.configure(0.004, 20.0)
    behind = camera._stamps.host_time
    monkeypatch.setattr(camera._stamps, "host_time", lambda stamp, latest: behind(stamp, latest=latest) - 5.0)
    with pytest.raises(DeviceFault, match="before it was asked for") as caught:
        camera.grab(timeout=0.2)
    assert caught.value.code == "camera.clock"
    camera.close()
