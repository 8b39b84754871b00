"""The simulated camera, spoken to by a client of a few lines written for this test."""

import json
import socket
import struct
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_backends.clock import WorldClock
from sim_backends.models.camera import CameraSpec
from sim_backends.peers.camera import frames as frame_peer
from sim_backends.peers.camera.frames import FramePeer

pytestmark = pytest.mark.wire
SPEC = CameraSpec(
    "SimCam", "SIM000007-SCAN", width=64, height=48, frame_rate_max=120.0, epoch=5000.0, drift_ppm=80.0, latency=0.0002
)


class Client:
    """Frames that come before a reply are kept."""

    def __init__(self, address: str) -> None:
        host, port = address.split(":")
        self.socket = socket.create_connection((host, int(port)), timeout=3.0)
        self.frames: list[tuple[dict[str, Any], bytes]] = []

    def send(self, **request: Any) -> None:
        text = json.dumps(request).encode()
        self.socket.sendall(b"CFS1" + struct.pack(">II", len(text), 0) + text)

    def receive(self) -> tuple[dict[str, Any], bytes]:
        magic, header, payload = struct.unpack(">4sII", self._read(12))
        assert magic == b"CFS1"
        return json.loads(self._read(header)), self._read(payload)

    def ask(self, **request: Any) -> dict[str, Any]:
        self.send(id=77, **request)
        while True:
            header, payload = self.receive()
            if header["op"] != "frame":
                assert (header["op"], header["id"]) == (request["op"], 77)
                return header
            self.frames.append((header, payload))

    def frame(self) -> dict[str, Any]:
        header, payload = self.frames.pop(0) if self.frames else self.receive()
        assert header["op"] == "frame"
        assert len(payload) == header["width"] * header["height"] == 64 * 48
        return header

    def _read(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self.socket.recv(count - len(data))
            if not part:
                raise EOFError
            data += part
        return data


@pytest.fixture
def clock() -> WorldClock:
    return WorldClock(5.0)


@pytest.fixture
def shutter() -> threading.Event:
    """Pictures are made while it is set."""
    made = threading.Event()
    made.set()
    return made


@pytest.fixture
def peer(clock: WorldClock, shutter: threading.Event) -> Iterator[FramePeer]:
    def render(t_mid: float, exposure: float) -> NDArray[np.uint8]:
        assert shutter.wait(10.0)
        return np.zeros((48, 64), np.uint8)

    peer = FramePeer("scan", clock, render, SPEC)
    peer.start()
    yield peer
    shutter.set()
    peer.stop()


@pytest.fixture
def client(peer: FramePeer) -> Iterator[Client]:
    client = Client(peer.address)
    yield client
    client.socket.close()


def test_a_frame_is_stamped_by_the_devices_clock_a_latency_after_its_exposure_began(clock: WorldClock):
    middles: list[float] = []

    def render(t_mid: float, exposure: float) -> NDArray[np.uint8]:
        middles.append(t_mid)
        return np.zeros((48, 64), np.uint8)

    peer = FramePeer("scan", clock, render, SPEC)
    peer.start()
    client = Client(peer.address)
    client.ask(op="configure", exposure_s=0.01, frame_rate_hz=50.0)
    client.ask(op="trigger")
    began = (1e-9 * client.frame()["device_ns"] - SPEC.epoch) / (1.0 + 1e-6 * SPEC.drift_ppm) - SPEC.latency
    peer.stop()
    client.socket.close()
    assert middles == [pytest.approx(began + 0.005, abs=1e-6)]


def test_slow_rendering_drops_exposures_beyond_the_backlog_and_says_so(
    client: Client, shutter: threading.Event, clock: WorldClock, monkeypatch
):
    monkeypatch.setattr(frame_peer, "BACKLOG_S", 63.5 / 120.0)
    shutter.clear()
    client.ask(op="start", frame_rate=120.0)
    clock.sleep(1.5)
    shutter.set()
    frames = [client.frame() for _ in range(84)]
    ids = [frame["frame_id"] for frame in frames]
    assert ids[:65] == list(range(1, 66))
    assert ids[65] > 114
    # A dropped exposure has taken its time all the same.
    grid = frames[0]["device_ns"] + (np.array(ids) - 1) * 1e9 / 120.0
    np.testing.assert_allclose([frame["device_ns"] for frame in frames], grid, atol=10)


@pytest.mark.parametrize(
    "request_, words",
    [
        ({"op": "configure", "exposure_s": 5.0, "frame_rate_hz": 10.0}, ("exposure_s", "2e-05 to 1 s")),
        ({"op": "configure", "exposure_s": 0.001, "frame_rate_hz": 500.0}, ("frame_rate_hz", "0.01 to 120 Hz")),
        ({"op": "configure", "exposure_s": 0.1, "frame_rate_hz": 50.0}, ("0.02 s", "10 Hz")),
        ({"op": "configure", "exposure_s": "long"}, ("exposure_s", "not a number")),
        ({"op": "start", "frame_rate": 0.0}, ("frame_rate", "0.01 to 120 Hz")),
        ({"op": "explode"}, ("unknown op", "identify")),
        ({"op": None}, ("unknown op",)),
    ],
)
def test_bad_requests_are_refused_with_the_reason(client: Client, request_: dict[str, Any], words: tuple[str]):
    reply = client.ask(**request_)
    assert reply["ok"] is False
    for word in words:
        assert word in reply["error"]
    assert client.ask(op="latch")["ok"]


def test_requests_that_clash_with_free_running_are_refused(client: Client):
    client.ask(op="start", frame_rate=20.0)
    for request in ({"op": "start"}, {"op": "trigger"}, {"op": "configure", "exposure_s": 0.001}):
        reply = client.ask(**request)
        assert not reply["ok"]
        assert "stop first" in reply["error"]


def test_garbage_ends_its_own_connection_only(peer: FramePeer):
    first = Client(peer.address)
    first.socket.sendall(b"GET / HTTP/1.1\r\n\r\n")
    header, _ = first.receive()
    assert not header["ok"]
    assert "CFS1" in header["error"]
    first.socket.close()
    half = Client(peer.address)
    half.socket.sendall(b"CFS1\x00\x00\x00\x20")
    half.socket.close()
    second = Client(peer.address)
    second.socket.sendall(b"CFS1" + struct.pack(">II", 3, 0) + b"{a:")
    assert not second.receive()[0]["ok"] and second.ask(op="latch")["ok"]
    second.socket.close()
