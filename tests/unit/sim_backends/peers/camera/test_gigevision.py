"""What a GigE Vision camera says and keeps, against the standard's own pictures of the bytes."""

import struct

import numpy as np
import pytest

from sim_backends.models.camera import CameraSpec
from sim_backends.peers.camera import gigevision as g

SPEC = CameraSpec("SimCam", "SIM000007-SCAN", 64, 48, frame_rate_max=120.0)


@pytest.fixture
def memory() -> g.GigeMemory:
    return g.GigeMemory(SPEC, "127.0.0.1")


def test_the_bootstrap_registers_say_what_it_is(memory: g.GigeMemory):
    assert memory.word(0x0000) == 0x00010002, "version 1.2"
    assert memory.read(0x00D8, 16).rstrip(b"\0") == b"SIM000007-SCAN"
    name, address, size = memory.read(0x0200, 512).rstrip(b"\0").decode().removeprefix("Local:").split(";")
    text = memory.read(int(address, 16), int(size, 16))
    assert name.endswith(".xml") and text.startswith(b"<?xml") and b"ExposureTime" in text


def test_registers_keep_their_ranges_and_the_payload_follows(memory: g.GigeMemory):
    for address, value, status in (
        (g.WIDTH, 65, g.GvcpStatus.INVALID_PARAMETER), (g.PIXEL_FORMAT, 7, g.GvcpStatus.INVALID_PARAMETER),
        (g.HEARTBEAT, 10, g.GvcpStatus.INVALID_PARAMETER), (0x0000, 1, g.GvcpStatus.WRITE_PROTECT),
    ):  # fmt: skip
        with pytest.raises(g.GvcpRefused) as refused:
            memory.write(address, struct.pack(">I", value))
        assert refused.value.status is status
    with pytest.raises(g.GvcpRefused):
        memory.write(g.EXPOSURE, struct.pack(">d", float("nan")))
    memory.write(g.WIDTH, struct.pack(">I", 32))
    memory.write(g.PIXEL_FORMAT, struct.pack(">I", 0x010C0006))
    assert memory.word(g.PAYLOAD) == 32 * 48 * 12 // 8


def test_pixels_are_packed_as_the_standards_lay_them_out():
    image = np.array([[0xAB, 0xCD, 0x12, 0x34]], np.uint8)
    ten = [value << 2 for value in image[0].tolist()]
    expected = {
        "Mono8": image.tobytes(), "Mono12": struct.pack("<4H", 0xAB0, 0xCD0, 0x120, 0x340), "RGB8": b"\xab" * 3,
        "Mono12Packed": bytes([0xAB, 0x00, 0xCD, 0x12, 0x00, 0x34]),
        "Mono12p": bytes([0xB0, 0x0A, 0xCD, 0x20, 0x01, 0x34]),
        "Mono10p": struct.pack("<Q", sum(value << 10 * k for k, value in enumerate(ten)))[:5],
    }  # fmt: skip
    made = {name: encode(image) for name, _, encode in g.ENCODERS.values()}
    assert {name: made[name][: len(data)] for name, data in expected.items()} == expected
