"""The camera driver on the simulated camera's wire: fresh frames, true times, known losses."""

import math
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from cell.devices.diagnosis.diagnosis import examine
from drivers.camera.stream import StreamCamera, answers
from drivers.clock import Clock
from drivers.errors import Aborted, ConfigError, DeadlineError, DeviceFault, NotConnectedError
from drivers.interfaces import Frame
from sim_backends.clock import WorldClock
from sim_backends.peers.camera.frames import FramePeer, message
from tests.support.wire.clocks import ahead
from tests.support.wire.gige_bench import SPEC, render

SPEED = 4.0


@dataclass
class Bench:
    """A camera on its wire whose pictures carry the world time that they show."""

    camera: StreamCamera
    peer: FramePeer
    world: WorldClock
    clock: Clock

    def shown(self, frame: Frame) -> float:
        """Host time that the picture shows, as drawn into its first pixels."""
        world = float(np.frombuffer(frame.image[0, :8].tobytes(), np.float64)[0])
        return world + ahead(self.clock, self.world)


@pytest.fixture
def bench() -> Iterator[Bench]:
    world, clock = WorldClock(SPEED), Clock(SPEED)
    peer = FramePeer("scan_camera", world, render, SPEC)
    peer.start()
    camera = StreamCamera("scan_camera", peer.address, clock=clock, shape=(48, 64))
    try:
        yield Bench(camera, peer, world, clock)
    finally:
        camera.close()
        peer.stop()
    assert not [thread for thread in threading.enumerate() if thread.name == "scan_camera reader"]


def test_a_frame_that_was_exposed_as_for_another_setting_is_refused(bench: Bench, monkeypatch):
    """The camera's sixth frame lies; the five before it are good."""
    bench.camera.configure(0.004, 50.0)
    sent: list[int] = []

    def lying(header: dict[str, Any], payload: bytes = b"") -> bytes:
        if header["op"] == "frame":
            sent.append(header["frame_id"])
            if len(sent) == 6:
                header = {**header, "exposure_s": 0.012}
        return message(header, payload)

    monkeypatch.setattr("sim_backends.peers.camera.frames.message", lying)
    with bench.camera.stream() as frames:
        got = [frames.next(2.0).frame_id for _ in range(5)]
        with pytest.raises(DeviceFault, match="another setting") as met:
            frames.next(2.0)
    assert got == sent[:5]
    assert met.value.code == "camera.exposure"
    monkeypatch.undo()
    bench.camera.grab()


def test_a_frame_that_is_lost_while_the_camera_is_examined_is_told_with_a_remedy(bench: Bench):
    bench.peer.fault("camera.frame_loss")
    found = {reading.what: reading for reading in examine("camera", bench.camera, [0.001], Clock())}
    assert found["frames lost"].value == 1.0
    assert not found["frames lost"].ok
    assert "cable" in found["frames lost"].remedy


@pytest.mark.wire
def test_a_grabbed_frame_was_exposed_after_the_call_and_its_time_is_true(bench: Bench):
    bench.camera.configure(exposure=0.004, frame_rate=50.0)
    for _ in range(3):
        called = bench.clock.now()
        frame = bench.camera.grab()
        assert frame.image.shape == (48, 64)
        assert (frame.image.dtype, frame.image[47, 63], frame.exposure) == (np.uint8, 200, 0.004)
        assert bench.shown(frame) > called
        assert frame.mid_exposure == pytest.approx(bench.shown(frame), abs=0.002)
        assert frame.received > frame.host_time


@pytest.mark.wire
def test_a_stream_is_complete_and_its_times_are_true(bench: Bench):
    bench.camera.configure(exposure=0.002, frame_rate=100.0)
    with bench.camera.stream() as stream:
        frames = [stream.next(2.0) for _ in range(100)]
    assert np.all(np.diff([frame.frame_id for frame in frames]) == 1)
    assert stream.lost == 0
    assert np.diff([frame.host_time for frame in frames]) == pytest.approx(np.full(99, 0.01), abs=1e-5)
    assert np.max(np.abs([frame.mid_exposure - bench.shown(frame) for frame in frames])) < 0.002


@pytest.mark.wire
def test_lost_frames_are_known(bench: Bench):
    bench.camera.configure(exposure=0.002, frame_rate=100.0)
    bench.peer.fault("camera.frame_loss", 2)
    with bench.camera.stream() as stream:
        first = stream.next(2.0)
        assert (first.lost_before, stream.lost) == (2, 2)
        bench.peer.fault("camera.frame_loss", 3)
        gaps = [stream.next(2.0).lost_before for _ in range(50)]
    assert [gap for gap in gaps if gap] == [3]
    assert stream.lost == 5
    assert bench.camera.statistics.errors["frames_lost"] == 5


@pytest.mark.wire
def test_pictures_that_nobody_takes_are_counted_as_lost_and_not_kept_for_ever(bench: Bench, monkeypatch):
    monkeypatch.setattr("drivers.camera.frame_queue.QUEUE_BYTES", 0)
    bench.camera.configure(exposure=0.002, frame_rate=100.0)
    with bench.camera.stream() as stream:
        bench.clock.sleep(1.0)
        frames = [stream.next(1.0) for _ in range(9)]
        assert [frame.lost_before for frame in frames[:8]] == [0] * 8
        assert frames[8].lost_before > 20
        assert stream.lost == frames[8].lost_before


@pytest.mark.wire
def test_an_answer_without_a_number_is_a_fault_of_the_protocol(bench: Bench, monkeypatch):
    ask = bench.camera._link.request
    wrong: dict[str, object] = {}

    def spoilt(op: str, **values: object) -> object:
        header, *rest = ask(op, **values)
        return {**header, **wrong}, *rest

    monkeypatch.setattr(bench.camera._link, "request", spoilt)
    for name, value, use in (
        ("height", 0, bench.camera.identity),
        ("exposure_min_s", math.nan, bench.camera.identity),
        ("exposure_s", math.nan, lambda: bench.camera.configure(0.002, 100.0)),
        ("next_frame_id", "7", bench.camera.grab),
        ("next_frame_id", math.inf, bench.camera.grab),
        ("device_ns", None, bench.camera._compare_clocks),
    ):
        wrong.clear()
        wrong[name] = value
        with pytest.raises(DeviceFault, match=rf"{name}.* (is|are) .*{value!r}") as caught:
            use()
        assert caught.value.code == "camera.protocol"


@pytest.mark.wire
def test_stop_ends_a_stream_that_waits(bench: Bench):
    bench.camera.configure(exposure=0.5, frame_rate=0.5)
    with bench.camera.stream() as stream:
        stream.next(10.0)
        stopper = threading.Timer(0.1, bench.camera.stop)
        stopper.start()
        with pytest.raises(Aborted):
            stream.next(60.0)
        stopper.join(2.0)


@pytest.mark.wire
def test_a_silent_camera_is_a_deadline(bench: Bench):
    bench.camera.configure(exposure=0.002, frame_rate=100.0)
    with bench.camera.stream() as stream:
        stream.next(1.0)
        bench.peer.fault("camera.silent")
        with pytest.raises(DeadlineError, match=r"no frame within 0\.5 s"):
            while True:
                stream.next(0.5)
        bench.peer.clear()
        assert stream.next(2.0).frame_id > 1


@pytest.mark.wire
def test_what_ended_a_stream_stays_the_error_when_the_camera_does_not_stop(bench: Bench):
    fault = DeviceFault("arm", "arm.emergency_stop", "emergency stop", recoverable=False, hint="Release it.")
    with pytest.raises(DeviceFault) as caught, bench.camera.stream():
        bench.peer.fault("camera.silent")
        raise fault
    bench.peer.clear()
    assert caught.value is fault
    assert "no answer to 'stop'" in caught.value.__notes__[0]


@pytest.mark.wire
def test_a_camera_that_dies_is_lost_at_once(bench: Bench):
    with bench.camera.stream() as stream:
        stream.next(2.0)
        bench.peer.stop()
        before = bench.clock.now()
        with pytest.raises(DeviceFault, match="camera lost") as caught:
            while True:
                stream.next(100.0)
        assert bench.clock.now() - before < 10.0
    assert caught.value.code == "camera.lost"
    with pytest.raises(DeviceFault, match="camera lost"):
        bench.camera.grab()
    bench.camera.close()
    with pytest.raises(NotConnectedError):
        bench.camera.grab()


@pytest.mark.wire
def test_a_second_client_and_a_wrong_size_are_refused(bench: Bench):
    with pytest.raises(DeviceFault, match="in use by another client"):
        StreamCamera("second", bench.peer.address, clock=Clock())
    assert bench.camera.grab().frame_id > 0
    bench.camera.close()
    with pytest.raises(ConfigError, match="64x48 pixels, configured are 1280x1024"):
        StreamCamera("scan_camera", bench.peer.address, clock=Clock(), shape=(1024, 1280))


@pytest.mark.wire
def test_a_port_without_a_camera_is_named():
    with pytest.raises(NotConnectedError, match=r"127\.0\.0\.1:1"):
        StreamCamera("scan_camera", "127.0.0.1:1", clock=Clock())
    with pytest.raises(ConfigError, match="HOST:PORT"):
        StreamCamera("scan_camera", "nowhere", clock=Clock())


@pytest.mark.wire
def test_a_peer_of_another_protocol_is_recognised():
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            connection.recv(1000)
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

    server = threading.Thread(target=serve, daemon=True)
    server.start()
    with pytest.raises(DeviceFault, match="instead of b'CFS1'"):
        StreamCamera("scan_camera", f"127.0.0.1:{listener.getsockname()[1]}", clock=Clock())
    server.join(2.0)
    listener.close()


@pytest.mark.parametrize(
    ("header", "answer"),
    [
        ({"op": "stop", "id": 7, "ok": True}, True),
        ({"op": "stop", "id": 6, "ok": True}, False),
        ({"op": "event", "ok": True}, False),
        ({"op": "event"}, False),
        ({"ok": False, "error": "what was that?"}, True),
    ],
)
def test_what_comes_unasked_answers_nothing(header: dict[str, object], answer: bool):
    assert answers(header, 7) == answer
