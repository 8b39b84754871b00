"""The GenICam driver over real GigE Vision: Aravis on one side, the simulated camera on the other, loopback between."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from cell.devices.contracts import Bench as ContractBench
from cell.devices.contracts import CameraContract
from drivers.camera.genicam.acquisition import FORMATS, BlockCount, Network
from drivers.camera.genicam.camera import ExposureTrigger, GenicamCamera, GenicamSetup, Region
from drivers.camera.genicam.device import GigePlace
from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError, DeviceFault, InterlockError, LimitError, NotConnectedError
from drivers.interfaces import Camera
from tests.support.wire.gige_bench import SPEC, WHOLE, Bench, require_aravis, served

pytestmark = pytest.mark.wire


@pytest.fixture
def bench() -> Iterator[Bench]:
    with served() as made:
        yield made
    assert not [thread for thread in threading.enumerate() if thread.name == "scan_camera pictures"]


class TestContract(CameraContract):
    """What the cell relies on in any camera."""

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Iterator[ContractBench[Camera]]:
        with served() as made:
            contract: ContractBench[Camera] = ContractBench(made.open, made.clock)
            yield contract
            contract.over()


# --- time ---


def test_times_are_those_that_the_pictures_show(bench: Bench) -> None:
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


def test_stamps_that_are_none_of_the_exposure_are_refused() -> None:
    with served(replace(SPEC, latency=-0.2)) as bench:
        camera = bench.open()
        camera.configure(0.004, 50.0)
        with pytest.raises(DeviceFault, match="before it was triggered") as caught:
            camera.grab()
        camera.close()
    assert caught.value.code == "camera.clock"


def test_stamps_that_lie_in_the_future_end_a_stream() -> None:
    """As after a time service has set the camera's clock: nothing of it may be paired with the rail."""
    with served(replace(SPEC, latency=0.2)) as bench:
        camera = bench.open()
        camera.configure(0.004, 50.0)
        with pytest.raises(DeviceFault, match="too late to be here already") as caught, camera.stream() as frames:
            frames.next(5.0)
        camera.close()
    assert caught.value.code == "camera.clock"


def test_block_ids_of_16_bits_begin_again_at_1() -> None:
    count = BlockCount()
    assert [count.of(block) for block in (65533, 65534, 65535, 1, 2, 5)] == [1, 2, 3, 4, 5, 8]
    long = BlockCount()
    assert [long.of(block) for block in (70_000, 70_001, 70_004)] == [1, 2, 5]


def test_a_picture_out_of_turn_is_no_new_beginning_of_the_block_ids() -> None:
    count = BlockCount()
    assert [count.of(block) for block in (10, 12, 11, 13)] == [1, 3, 2, 4]
    around = BlockCount()
    assert [around.of(block) for block in (65534, 1, 65535, 2)] == [1, 3, 2, 4]


# --- settings ---


@pytest.mark.parametrize(
    "name", ["Mono8", "Mono10", "Mono10Packed", "Mono10p", "Mono12", "Mono12Packed", "Mono12p", "BayerRG8", "RGB8"]
)
def test_every_pixel_format_comes_as_the_grey_that_was_sent(bench: Bench, name: str) -> None:
    camera = bench.open(GenicamSetup(WHOLE, name))
    camera.configure(0.004, 50.0)
    image = camera.grab().image
    camera.close()
    assert image.shape == (48, 64)
    assert (image[4:44, 4:60] == 100).all()
    assert image[47, 63] == 200 or name == "BayerRG8"  # which mixes neighbours


def test_region_gain_and_packet_size_are_set(bench: Bench) -> None:
    camera = bench.open(GenicamSetup(Region(32, 16, 32, 32), gain=6.0206, network=Network(packet_size=576)))
    camera.configure(0.004, 50.0)
    image = camera.grab().image
    camera.close()
    assert image.shape == (16, 32)
    assert image[0, 0] == 200
    assert image[15, 31] == 255


def test_what_the_camera_has_not_is_refused_with_what_it_has(bench: Bench) -> None:
    with pytest.raises(LimitError, match=r"Width 80 is none .*allowed: 16 to 64 in steps of 1"):
        bench.open(GenicamSetup(Region(80, 48)))
    with pytest.raises(LimitError, match="OffsetX 80 is none"):
        bench.open(GenicamSetup(Region(32, 16, 80, 0)))
    with pytest.raises(DeviceFault, match="no PixelFormat Mono16, it stays Mono8"):
        bench.open(GenicamSetup(WHOLE, "Mono16"))
    with pytest.raises(LimitError, match="gain 90"):
        bench.open(GenicamSetup(WHOLE, gain=90.0))
    bench.open().close()


def test_a_line_triggers_streams_and_photographs(bench: Bench) -> None:
    camera = bench.open(GenicamSetup(WHOLE, trigger=ExposureTrigger("line")))
    camera.configure(0.004, 50.0)
    with camera.stream() as frames:
        with pytest.raises(DeadlineError):
            frames.next(0.3)
        bench.peer.pulse()
        first = frames.next(5.0)
        bench.peer.pulse()
        assert frames.next(5.0).frame_id == first.frame_id + 1
    camera.close()


def test_a_photograph_can_come_from_a_free_run(bench: Bench) -> None:
    camera = bench.open(GenicamSetup(WHOLE, trigger=ExposureTrigger("free")))
    camera.configure(0.004, 20.0)
    called = bench.clock.now()
    assert bench.shown(camera.grab()) > called
    camera.close()


# --- the network ---


def test_lost_packets_come_again(bench: Bench) -> None:
    camera = bench.open(GenicamSetup(WHOLE, network=Network(packet_size=576)))
    camera.configure(0.004, 20.0)
    bench.peer.lose_packets(lambda number: number in (2, 3))
    with camera.stream() as frames:
        made = [frames.next(5.0) for _ in range(5)]
    camera.close()
    assert frames.lost == 0
    assert all((frame.image[10:] == 100).sum() == 38 * 64 - 1 for frame in made)
    assert camera.statistics.errors["resent_packets"] >= 10


def test_without_resending_a_picture_with_a_hole_is_lost_and_never_handed_out(bench: Bench) -> None:
    camera = bench.open(GenicamSetup(WHOLE, network=Network(packet_size=576, resend=False, retention=0.05)))
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


def test_lost_exposures_are_known_from_the_block_ids(bench: Bench) -> None:
    camera = bench.open()
    camera.configure(0.002, 100.0)
    with camera.stream() as frames:
        frames.next(5.0)
        bench.peer.fault("camera.frame_loss", 3)
        gaps = [frames.next(5.0).lost_before for _ in range(60)]
    camera.close()
    assert [gap for gap in gaps if gap] == [3]
    assert frames.lost == 3


def test_another_application_that_holds_the_camera_is_named(bench: Bench) -> None:
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


def test_a_lost_link_is_told_and_the_camera_is_used_again_when_it_is_back(bench: Bench) -> None:
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


def test_a_silent_camera_is_a_deadline_and_is_used_again(bench: Bench) -> None:
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


def test_who_ends_an_acquisition_does_not_wait_for_a_silent_camera(bench: Bench) -> None:
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


def test_another_camera_at_the_address_is_not_taken_for_the_lost_one() -> None:
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


def test_stop_ends_a_stream_that_waits(bench: Bench) -> None:
    camera = bench.open(GenicamSetup(WHOLE, trigger=ExposureTrigger("line")))
    camera.configure(0.004, 50.0)
    with camera.stream() as frames:
        stopper = threading.Timer(0.1, camera.stop)
        stopper.start()
        with pytest.raises(Aborted):
            frames.next(60.0)
        stopper.join(2.0)
    camera.close()
    with pytest.raises(NotConnectedError):
        camera.grab()


def test_an_address_without_a_camera_is_named_with_a_remedy() -> None:
    require_aravis()
    with pytest.raises(NotConnectedError, match=r"127\.1\.255\.254.*Remedy: check power and cable"):
        GenicamCamera("scan_camera", GigePlace("127.1.255.254"), GenicamSetup(WHOLE), clock=Clock())


# --- formats, by the standard's own pictures of the bytes ---


def test_packed_pixels_are_read_as_the_standards_lay_them_out() -> None:
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
def test_each_bayer_pattern_gives_the_grey_of_its_colours(name: str, tile: str) -> None:
    colour = {"R": 200, "G": 120, "B": 40}
    raw = np.tile(np.array([colour[c] for c in tile], np.uint8).reshape(2, 2), (8, 8))
    grey = FORMATS[f"Bayer{name}8"].grey(raw.reshape(-1), 16, 16)
    luma = 0.299 * 200 + 0.587 * 120 + 0.114 * 40
    assert grey[4:12, 4:12] == pytest.approx(np.full((8, 8), luma), abs=1.5)
