"""A folder of recorded pictures with their times, as a camera; and what V4L2 pictures become."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.devices.assembly import connect
from cell.devices.contracts import Bench, CameraContract
from cell.makes import make_of
from drivers.camera.folder import RecordedCamera, read_image
from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceFault, LimitError, NotConnectedError, RefusedError
from drivers.interfaces import Camera
from drivers.make import Surroundings
from tests.support.wire.cells import named

RATE_HZ, EXPOSURE_S = 10.0, 0.005


def record(folder: Path, numbers: list[int]) -> Path:
    """Pictures at 10 Hz whose grey is their number; those numbers that are left out were lost."""
    folder.mkdir(exist_ok=True)
    lines = ["file,time_s,exposure_s,frame"]
    for number in numbers:
        cv2.imwrite(str(folder / f"{number}.png"), np.full((48, 64), number, np.uint8))
        lines.append(f"{number}.png,{100.0 + number / RATE_HZ},{EXPOSURE_S},{number}")
    (folder / "times.csv").write_text("\n".join(lines), encoding="utf-8")
    return folder


def opened(folder: Path, clock: Clock | None = None) -> RecordedCamera:
    return RecordedCamera("recording", folder, clock=clock or Clock(10.0), shape=(48, 64))


class TestContract(CameraContract):
    """What the cell relies on in any camera, of a recording that was taken as the suite takes it."""

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench[Camera]]:
        folder = record(tmp_path_factory.mktemp("recording") / "frames", [n for n in range(1, 40) if n % 6])
        clock = Clock(10.0)
        made: Bench[Camera] = Bench(lambda: opened(folder, clock), clock)
        yield made
        made.over()


def test_pictures_are_played_at_the_pace_at_which_they_were_taken(tmp_path):
    clock = Clock(5.0)
    camera = opened(record(tmp_path / "r", [1, 2, 3, 5, 6]), clock)
    with camera.stream() as frames:
        begun = clock.now()
        made = [frames.next(5.0) for _ in range(5)]
        took = clock.now() - begun
    assert [int(frame.image[0, 0]) for frame in made] == [1, 2, 3, 5, 6]
    assert [frame.lost_before for frame in made] == [0, 0, 0, 1, 0]
    assert np.diff([frame.host_time for frame in made]) == pytest.approx([0.1, 0.1, 0.2, 0.1])
    assert 0.5 <= took < 1.5
    assert camera.time_bound == float("inf")
    with pytest.raises(DeviceFault, match="all 5 pictures"):
        camera.grab()


def test_what_is_wrong_with_a_recording_is_named(tmp_path):
    folder = record(tmp_path / "r", [1, 2, 3])
    good = (folder / "times.csv").read_text()
    for text, words in (
        (good.replace("time_s", "when"), r"times\.csv, line 2: KeyError"),
        (good.replace("100.2", "soon"), "line 3: ValueError"),
        (good.replace("100.2", "99"), "line 3: time and frame must grow"),
        (good.replace(str(EXPOSURE_S), "0"), "line 2: .*exposure 0 s"),
        ("file,time_s,exposure_s\n", "has 0 pictures"),
    ):
        (folder / "times.csv").write_text(text)
        with pytest.raises(ConfigError, match=words):
            opened(folder)
    (folder / "times.csv").write_text(good, encoding="utf-8-sig")  # as spreadsheets write it
    opened(folder)
    (folder / "times.csv").write_text(good, encoding="utf-16")
    with pytest.raises(ConfigError, match="is no table of text"):
        opened(folder)
    (folder / "times.csv").unlink()
    with pytest.raises(ConfigError, match="cannot be read"):
        opened(folder)
    with pytest.raises(NotConnectedError, match="is not a folder"):
        opened(tmp_path / "nowhere")


def test_another_exposure_or_rate_than_the_recorded_is_refused(tmp_path):
    camera = opened(record(tmp_path / "r", [1, 2, 3]))
    camera.configure(EXPOSURE_S, RATE_HZ)
    with pytest.raises(LimitError, match=r"exposure 20 ms is not that of the recording .*allowed: 5 ms"):
        camera.configure(0.02, RATE_HZ)
    with pytest.raises(LimitError, match=r"frame rate 30 Hz .*allowed: 10 Hz"):
        camera.configure(EXPOSURE_S, 30.0)


def test_a_bad_picture_is_refused_by_name_and_the_next_one_comes(tmp_path):
    folder = record(tmp_path / "r", [1, 2, 3, 4, 5, 6])
    noise = np.random.default_rng(1).integers(0, 255, (48, 64), dtype=np.uint8)
    whole = cv2.imencode(".jpg", noise)[1].tobytes()
    (folder / "2.png").write_bytes((folder / "2.png").read_bytes()[:40])
    (folder / "3.png").write_bytes(whole[: 2 * len(whole) // 3])
    (folder / "4.png").write_text("this is text")
    cv2.imwrite(str(folder / "5.png"), np.zeros((20, 30), np.uint8))
    camera = opened(folder)
    camera.grab()
    for words in (
        r"2\.png: is cut off",
        r"3\.png: is cut off",
        r"4\.png: is not a picture .*12 bytes",
        r"5\.png: has 30x20 pixels instead of 64x48",
    ):
        with pytest.raises(RefusedError, match=words):
            camera.grab()
    assert camera.grab().frame_id == 6
    with pytest.raises(RefusedError, match=r"missing\.png"):
        read_image(folder / "missing.png")
    cv2.imwrite(str(folder / "colour.png"), np.full((5, 5, 3), (0, 0, 255), np.uint8))
    assert read_image(folder / "colour.png").shape == (5, 5)


def test_nothing_moves_by_a_recording(tmp_path):
    record(tmp_path / "frames", [1, 2])
    config = load_config(named(tmp_path, "folder", f'folder = "{tmp_path / "frames"}"'))
    with pytest.raises(ConfigError, match=r'scan_camera\.driver = "folder" plays recorded pictures, .*rail'):
        connect(config, ("rail", "scan_camera"))


def test_a_device_file_without_a_camera_is_named_with_remedies():
    make = make_of("camera", "v4l2")
    record = make.record.model_construct(device="/dev/video77", width=640, height=480, pixel_format="YUYV", gain=None)
    with pytest.raises(NotConnectedError, match=r"/dev/video77 is no camera .*v4l2-ctl .*fuser"):
        make.connect("scan_camera", record, Surroundings(Clock()))
