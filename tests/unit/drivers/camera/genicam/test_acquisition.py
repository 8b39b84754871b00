"""Promises of `drivers.camera.genicam.acquisition`."""

import struct
import time

import numpy as np
import pytest

from drivers.camera.genicam.acquisition import FORMATS, BlockCount
from drivers.errors import DeadlineError, DeviceFault
from tests.support.wire.gige_bench import Bench

pytestmark = pytest.mark.wire


def test_block_ids_of_16_bits_begin_again_at_1():
    count = BlockCount()
    assert [count.of(block) for block in (65533, 65534, 65535, 1, 2, 5)] == [1, 2, 3, 4, 5, 8]
    long = BlockCount()
    assert [long.of(block) for block in (70_000, 70_001, 70_004)] == [1, 2, 5]


def test_a_picture_out_of_turn_is_no_new_beginning_of_the_block_ids():
    count = BlockCount()
    assert [count.of(block) for block in (10, 12, 11, 13)] == [1, 3, 2, 4]
    around = BlockCount()
    assert [around.of(block) for block in (65534, 1, 65535, 2)] == [1, 3, 2, 4]


@pytest.mark.parametrize(
    "name", ["Mono8", "Mono10", "Mono10Packed", "Mono10p", "Mono12", "Mono12Packed", "Mono12p", "BayerRG8", "RGB8"]
)
def test_every_pixel_format_comes_as_the_grey_that_was_sent(bench: Bench, name: str):
    camera = bench.open(pixel_format=name)
    camera.configure(0.004, 50.0)
    image = camera.grab().image
    camera.close()
    assert image.shape == (48, 64)
    assert (image[4:44, 4:60] == 100).all()
    assert image[47, 63] == 200 or name == "BayerRG8"  # which mixes neighbours


def test_lost_packets_come_again(bench: Bench):
    camera = bench.open(packet_size=576)
    camera.configure(0.004, 20.0)
    bench.peer.lose_packets(lambda number: number in (2, 3))
    with camera.stream() as frames:
        made = [frames.next(5.0) for _ in range(5)]
    camera.close()
    assert frames.lost == 0
    assert all((frame.image[10:] == 100).sum() == 38 * 64 - 1 for frame in made)
    assert camera.statistics.errors["resent_packets"] >= 10


def test_without_resending_a_picture_with_a_hole_is_lost_and_never_handed_out(bench: Bench):
    camera = bench.open(packet_size=576, resend=False, retention=0.05)
    camera.configure(0.004, 20.0)
    lose = iter([True, False, True] + [False] * 1000)
    bench.peer.lose_packets(lambda number: number == 3 and next(lose))
    with camera.stream() as frames:
        made = [frames.next(5.0) for _ in range(4)]
    assert [frame.lost_before for frame in made][:2] == [0, 1]
    assert camera.statistics.errors["frames_incomplete"] == 2
    bench.peer.lose_packets(lambda number: number == 3)
    with pytest.raises(DeviceFault, match=r"packets of a picture were lost .*packet_size") as caught:
        camera.grab()
    camera.close()
    assert caught.value.code == "camera.packets_lost"


def test_lost_exposures_are_known_from_the_block_ids(bench: Bench):
    camera = bench.open()
    camera.configure(0.002, 100.0)
    with camera.stream() as frames:
        frames.next(5.0)
        bench.peer.fault("camera.frame_loss", 3)
        gaps = [frames.next(5.0).lost_before for _ in range(60)]
    camera.close()
    assert [gap for gap in gaps if gap] == [3]
    assert frames.lost == 3


def test_who_ends_an_acquisition_does_not_wait_for_a_silent_camera(bench: Bench):
    camera = bench.open()
    camera.configure(0.004, 50.0)
    with pytest.raises(DeadlineError) as caught, camera.stream() as frames:
        frames.next(5.0)
        bench.peer.fault("camera.silent")
        begun = time.monotonic()
        while True:
            frames.next(0.3)
    assert time.monotonic() - begun < 2.5
    assert "no answer to the end of its acquisition" in caught.value.__notes__[0]
    bench.peer.clear()
    camera.close()


def test_packed_pixels_are_read_as_the_standards_lay_them_out():
    first, second, third, fourth = 0b1011001110, 0b0100110001, 0b1111000010, 0b0000111101
    gige10 = bytes([first >> 2, (second & 3) << 4 | first & 3, second >> 2])
    gige12 = bytes([0xAB, 0x6 << 4 | 0xC, 0xDE])  # 0xABC and 0xDE6
    pfnc12 = bytes([0xBC, 0x6 << 4 | 0xA, 0xDE])
    pfnc10 = struct.pack("<Q", first | second << 10 | third << 20 | fourth << 30)[:5]
    for name, data, expected in (
        ("Mono10Packed", gige10, [first >> 2, second >> 2]),
        ("Mono12Packed", gige12, [0xAB, 0xDE]),
        ("Mono12p", pfnc12, [0xAB, 0xDE]),
        ("Mono10p", pfnc10, [value >> 2 for value in (first, second, third, fourth)]),
        ("Mono12", struct.pack("<2H", 0xABC, 0xDE6), [0xAB, 0xDE]),
    ):
        grey = FORMATS[name].grey(np.frombuffer(data, np.uint8), 1, len(expected))
        assert grey.tolist() == [expected], name


@pytest.mark.parametrize(("name", "tile"), [("RG", "RGGB"), ("GR", "GRBG"), ("GB", "GBRG"), ("BG", "BGGR")])
def test_each_bayer_pattern_gives_the_grey_of_its_colours(name: str, tile: str):
    colour = {"R": 200, "G": 120, "B": 40}
    raw = np.tile(np.array([colour[c] for c in tile], np.uint8).reshape(2, 2), (8, 8))
    grey = FORMATS[f"Bayer{name}8"].grey(raw.reshape(-1), 16, 16)
    luma = 0.299 * 200 + 0.587 * 120 + 0.114 * 40
    assert grey[4:12, 4:12] == pytest.approx(np.full((8, 8), luma), abs=1.5)
