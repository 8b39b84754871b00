"""Promises of `drivers.camera.genicam.device`."""

from dataclasses import replace

import pytest

from drivers.clock import Clock
from drivers.errors import DeadlineError, DeviceFault, InterlockError, NotConnectedError
from tests.support.wire.gige_bench import SPEC, Bench, opened, require_aravis, served

pytestmark = pytest.mark.wire


def test_stamps_that_are_none_of_the_exposure_are_refused():
    with served(replace(SPEC, latency=-0.2)) as bench:
        camera = bench.open()
        camera.configure(0.004, 50.0)
        with pytest.raises(DeviceFault, match="before it was asked for") as caught:
            camera.grab()
        camera.close()
    assert caught.value.code == "camera.clock"


def test_stamps_that_lie_in_the_future_end_a_stream():
    """As after a time service has set the camera's clock: nothing of it may be paired with the rail."""
    with served(replace(SPEC, latency=0.2)) as bench:
        camera = bench.open()
        camera.configure(0.004, 50.0)
        with pytest.raises(DeviceFault, match="too late to be here already") as caught, camera.stream() as frames:
            frames.next(5.0)
        camera.close()
    assert caught.value.code == "camera.clock"


def test_another_application_that_holds_the_camera_is_named(bench: Bench):
    first = bench.open()
    with pytest.raises(DeviceFault, match=r"another application on 127\.\S+ holds the camera") as caught:
        bench.open()
    assert caught.value.code == "camera.in_use"
    looking = bench.open(look=True)
    assert looking.identity().serial == SPEC.serial
    assert looking.ping() < 1.0
    with pytest.raises(InterlockError, match="only looked at"):
        looking.grab()
    looking.close()
    first.configure(0.004, 50.0)
    assert first.grab().frame_id == 1
    first.close()
    bench.open().close()


def test_a_lost_link_is_told_and_the_camera_is_used_again_when_it_is_back(bench: Bench):
    camera = bench.open()
    camera.configure(0.004, 50.0)
    with camera.stream() as frames:
        last = frames.next(5.0)
        # Someone else takes the camera: to the driver that is a link that does not come back by itself.
        bench.peer.drop_controller()
        with pytest.raises(DeviceFault, match=r"camera lost: .*connects anew") as caught:
            while True:
                frames.next(60.0)
    assert (caught.value.code, caught.value.recoverable) == ("camera.lost", True)
    again = camera.grab()
    assert again.exposure == pytest.approx(0.004)
    assert again.frame_id > last.frame_id
    assert camera.statistics.errors["link_lost"] == 1
    camera.close()


def test_a_silent_camera_is_a_deadline_and_is_used_again(bench: Bench):
    camera = bench.open()
    camera.configure(0.004, 50.0)
    with camera.stream() as frames:
        frames.next(5.0)
        bench.peer.fault("camera.silent")
        with pytest.raises(DeadlineError, match=r"no frame within 0\.5 s"):
            while True:
                frames.next(0.5)
        bench.peer.clear()
        assert frames.next(5.0).lost_before > 0
    assert camera.grab().exposure == pytest.approx(0.004)
    camera.close()


def test_another_camera_at_the_address_is_not_taken_for_the_lost_one():
    with served() as bench:
        camera = bench.open()
        host = bench.peer.address
    with served(replace(SPEC, serial="OTHER")) as bench:
        assert bench.peer.address == host
        with pytest.raises(DeviceFault, match="camera lost"):
            camera.grab(1.0)
        with pytest.raises(NotConnectedError, match="has serial number OTHER now, it was SIM000007-SCAN"):
            camera.grab(1.0)
        camera.close()


def test_an_address_without_a_camera_is_named_with_a_remedy():
    require_aravis()
    with pytest.raises(NotConnectedError, match=r"127\.1\.255\.254.*Remedy: check power and cable"):
        opened("127.1.255.254", Clock())
