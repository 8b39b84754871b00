"""A run's record: what others' readers find in it, how it survives being cut off, and perception fed with it again."""

from __future__ import annotations

import json
import logging
import math
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import cv2
import numpy as np
import pytest
from can.io.canutils import CanutilsLogReader
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from cell.apps.cli import main
from cell.devices.simulated.direct import VirtualCell
from cell.measure.reconstruction.ply import read_cloud
from cell.run.record import file as record_file
from cell.run.record import recorder
from cell.run.record.file import BY_TOPIC, RecordFile
from cell.run.record.reading import as_candump, as_text, information, messages
from cell.run.record.recorder import as_json, rtde, wire
from cell.run.record.repair import repair
from cell.run.record.replay import FILE as PERCEPTION
from cell.run.record.replay import replay
from cell.run.runs import Run
from drivers.errors import CellError, ConfigError
from drivers.interfaces import LinkStatistics
from drivers.vehicle.can_link import CanLink
from lab.bench.job.whole_job import JobRecord
from tests.support.report_runs import CONFIG

Messages = dict[str, list[tuple[int, Any]]]
"""By topic: times in ns and messages."""


@pytest.fixture(scope="module")
def folder(placed_pot: JobRecord) -> Path:
    assert placed_pot.folder is not None
    return placed_pot.folder


def by_the_library(path: Path) -> Messages:
    """Everything in a file as the library's own reader and the Protobuf decoder give it."""
    found: Messages = defaultdict(list)
    factory = DecoderFactory()
    with path.open("rb") as stream:
        reader = make_reader(stream)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            decode = factory.decoder_for(channel.message_encoding, schema) or json.loads
            found[channel.topic].append((message.log_time, decode(message.data)))
    return found


@pytest.fixture(scope="module")
def read(folder: Path) -> Messages:
    return by_the_library(folder / "record.mcap")


def test_the_libraries_own_reader_finds_every_channel_of_a_job_without_wires(read: Messages) -> None:
    assert set(read) <= set(BY_TOPIC)
    wires = {"/vehicle/can", "/arm/rtde", "/rail/serial", "/laser/serial", "/claw/serial"}
    # Nobody asks the laser itself during a job.
    assert set(BY_TOPIC) - set(read) == {*wires, "/laser/state"}
    for topic, found in read.items():
        schema = BY_TOPIC[topic].schema
        if schema.startswith("foxglove."):
            assert {type(message).DESCRIPTOR.full_name for _, message in found} == {schema}
    assert read["/record/end"] == [(read["/record/end"][0][0], {"dropped": {}, "cpu_s": None})]


def test_times_are_the_virtual_clocks(read: Messages, placed_pot: JobRecord) -> None:
    for stamp, frame in read["/scan_camera/frame"]:
        assert stamp == round(1e9 * (frame["host_time"] + 0.5 * frame["exposure"]))
    times = np.concatenate([swath.times for swath in placed_pot.results["laser_sweep"].swaths])
    lines = sorted(stamp for stamp, _ in read["/cloud/line"])
    assert np.abs(np.array(lines) - np.sort(np.round(1e9 * times))).max() <= 1


def test_frames_lead_from_the_root_to_where_the_arm_itself_says_that_its_flange_is(read: Messages) -> None:
    """The arm computes its flange from its own table; the chain is the joints' through the product's kinematics."""
    chains = [(stamp, {t.child_frame_id: t for t in message.transforms}) for stamp, message in read["/tf"]]
    arms = {stamp: chain for stamp, chain in chains if "flange" in chain}
    checked = 0
    for stamp, state in read["/arm/state"]:
        chain = arms[stamp]
        pose, name = np.eye(4), "flange"
        while name != "tf#/":
            step = chain[name]
            pose, name = matrix(step) @ pose, step.parent_frame_id
        told = np.array(state["flange"])
        assert np.allclose(pose[:3, 3], told[:3], atol=1e-7)
        assert np.allclose(pose[:3, :3], Rotation.from_rotvec(told[3:]).as_matrix(), atol=1e-7)
        checked += 1
    assert checked > 100
    root = chains[0][1]["base"]
    assert root.parent_frame_id == "tf#/" and np.array_equal(matrix(root), np.eye(4))


def matrix(transform: Any) -> np.ndarray[Any, Any]:
    made = np.eye(4)
    q, t = transform.rotation, transform.translation
    made[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    made[:3, 3] = t.x, t.y, t.z
    return made


def test_pictures_are_the_files_and_carry_the_lens_they_were_taken_with(
    read: Messages, folder: Path, placed_pot: JobRecord
) -> None:
    assert placed_pot.calibration is not None
    lenses = {"scan_camera": placed_pot.calibration.scan.camera, "target_camera": placed_pot.calibration.target.camera}
    kept = {path.name for path in (folder / "frames").iterdir()}
    for name, camera in lenses.items():
        told, images = read[f"/{name}/frame"], read[f"/{name}/image"]
        assert len(told) == len(images) == len(read[f"/{name}/calibration"])
        for (stamp, frame), (at, image) in zip(told, images, strict=True):
            assert (stamp, image.frame_id, image.format) == (at, name, "png")
            assert image.data == (folder / "frames" / frame["file"]).read_bytes()
            kept.discard(frame["file"])
        _, lens = read[f"/{name}/calibration"][0]
        points = np.array([[0.01, -0.02, 0.2], [0.0, 0.0, 1.0], [0.03, 0.01, 0.3]])
        # By OpenCV, whose model "plumb_bob" is.
        seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.array(lens.K).reshape(3, 3), np.array(lens.D))
        assert np.allclose(seen[:, 0], camera.project(points), atol=1e-6)
    assert not kept


def test_the_cloud_that_has_grown_is_the_cloud_of_the_run(read: Messages, folder: Path) -> None:
    stored = read_cloud(folder / "cloud.ply")
    measured = stored.points[~stored.interpolated].astype("<f4")
    lines = [np.frombuffer(message.data, "<f4").reshape(-1, 3) for _, message in sorted(read["/cloud/line"], key=first)]
    assert np.array_equal(np.concatenate(lines), measured)
    seconds = [stamp for stamp, _ in read["/cloud/grown"]]
    assert np.diff(seconds[:-1]).min() >= 1e9
    largest = np.frombuffer(read["/cloud/grown"][-1][1].data, "<f4").reshape(-1, 3)
    stride = math.ceil(len(measured) / 60_000)
    assert np.array_equal(largest, measured[::stride])


def first(pair: tuple[int, Any]) -> int:
    return pair[0]


def test_the_clouds_points_lie_on_the_stripe_of_the_picture_taken_then(read: Messages) -> None:
    """Frames, lens, picture and cloud tell one story: by OpenCV's projection and the bright line in the picture."""
    poses, chain = [], {}
    for stamp, message in sorted(read["/tf"], key=first):
        chain |= {t.child_frame_id: t for t in message.transforms}
        if "flange" in chain and any(t.child_frame_id == "scan_camera" for t in message.transforms):
            poses.append((stamp, base_from_camera(chain)))
    pictures = dict(read["/scan_camera/image"])
    lens = read["/scan_camera/calibration"][0][1]
    lines = read["/cloud/line"]
    for stamp, line in (lines[len(lines) // 4], lines[len(lines) // 2], lines[3 * len(lines) // 4]):
        at = min(pictures, key=lambda other: abs(other - stamp))
        image = cv2.imdecode(np.frombuffer(pictures[at].data, np.uint8), cv2.IMREAD_GRAYSCALE)
        k = next(k for k, (other, _) in enumerate(poses) if other > at)
        (before, earlier), (after, later) = poses[k - 1 : k + 1]
        share = (at - before) / (after - before)
        pose = (1 - share) * earlier + share * later
        points = np.frombuffer(line.data, "<f4").reshape(-1, 3).astype(float)
        seen = (points - pose[:3, 3]) @ pose[:3, :3]
        pixels, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), np.array(lens.K).reshape(3, 3), np.array(lens.D))
        columns, rows = np.rint(pixels[:, 0]).astype(int).T
        inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1] - 8)
        assert np.count_nonzero(inside) > 0.98 * len(points)
        columns, rows = columns[inside], rows[inside]
        brightness = image[rows, columns]
        assert np.median(brightness) > 5 * max(1.0, float(np.median(image)))
        # Half a millimetre beside it there is none.
        assert np.median(image[rows, columns + 8]) < 0.5 * np.median(brightness)


def base_from_camera(chain: dict[str, Any]) -> np.ndarray[Any, Any]:
    pose, name = np.eye(4), "scan_camera"
    while name != "base":
        pose, name = matrix(chain[name]) @ pose, chain[name].parent_frame_id
    return pose


def test_bodies_stand_in_frames_that_are_told_and_the_part_changes_hands(read: Messages) -> None:
    frames = {"base", *(t.child_frame_id for _, message in read["/tf"] for t in message.transforms)}
    there: dict[str, str] = {}
    history = []
    for _, update in read["/scene"]:
        for entity in update.entities:
            assert entity.frame_id in frames
            assert entity.cubes or entity.cylinders
            there[entity.id] = entity.frame_id
        for deletion in update.deletions:
            del there[deletion.id]
        history.append({name: there.get(name) for name in ("part", "placed part", "surface")})
    assert {"part": "flange", "placed part": None, "surface": "base"} in history
    assert history[-1] == {"part": None, "placed part": "base", "surface": "base"}


def test_the_sequence_its_commands_and_its_log_can_be_read_back(read: Messages) -> None:
    states = [message["to"] for _, message in read["/sequence/state"]]
    assert [*states[:3], states[-1]] == ["drive_to_target", "board_photo", "laser_sweep", "placed"]
    assert any(m["kind"] == "step_done" and m["step"] == "place" for _, m in read["/sequence/event"])
    assert [m["name"] for _, m in read["/claw/command"]] == ["release"]
    assert [m["name"] for _, m in read["/laser/command"]].count("lit") >= 1
    assert [m["name"] for _, m in read["/scan_camera/command"]][-2:] == ["stream", "stream ended"]
    assert "sweep" in [m["name"] for _, m in read["/rail/command"]]
    assert {message.level for _, message in read["/log"]} <= {2, 3}


def test_the_rails_readings_are_those_that_the_sweep_rests_on(read: Messages, placed_pot: JobRecord) -> None:
    (swath,) = placed_pot.results["laser_sweep"].swaths
    told = np.array([[m["stamp"], m["position"]] for _, m in read["/rail/state"]])
    told = told[np.argsort(told[:, 0], kind="stable")]
    assert np.abs(np.interp(swath.times, told[:, 0], told[:, 1]) - swath.rail).max() < 20e-6


# --- cut off ---


def written(path: Path, count: int = 60) -> list[tuple[str, int, bytes]]:
    """A small record, and what was put into it."""
    put = []
    out = RecordFile(path, {"run": "r"}, lossless=True)
    for k in range(count):
        topic = ("/sequence/event", "/rail/serial", "/vehicle/can")[k % 3]
        data = as_json({"sent": k % 2 == 0, "number": k, "data": "00" * (k * 7 % 90)})
        put.append((topic, 1000 + k, data))
        out.put(topic, 1000 + k, lambda data=data: data)
    out.close()
    assert out.failure is None and not out.dropped
    return put


def raw(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        read = make_reader(stream).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in read]


def test_a_record_cut_off_anywhere_is_closed_with_all_that_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_file, "CHUNK_BYTES", 700)
    put = written(tmp_path / "whole.mcap")
    data = (tmp_path / "whole.mcap").read_bytes()
    assert raw(tmp_path / "whole.mcap")[:-1] == put
    cut = tmp_path / "cut.mcap"
    for size in [*range(0, len(data), 97), len(data) - 9, len(data) - 1]:
        cut.write_bytes(data[:size])
        done = repair(cut)
        assert not done.whole
        # The library reads it, and every message whose last byte was there is there.
        assert [message for message in raw(cut) if message[0] != "/record/end"] == [
            message for message in put if message[2] in data[:size]
        ]
        assert repair(cut).whole


def test_a_flipped_bit_anywhere_is_named_and_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record_file, "CHUNK_BYTES", 700)
    put = written(tmp_path / "whole.mcap")
    data, path = (tmp_path / "whole.mcap").read_bytes(), tmp_path / "record.mcap"
    rng = np.random.default_rng(5)
    for at in rng.choice(len(data), 400, replace=False).tolist():
        bad = bytearray(data)
        bad[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(bad)
        try:
            told = information(path)
            done = repair(path)
        except CellError as error:
            assert "MCAP" in str(error) and at < 8
            continue
        assert not told["whole"] and not done.whole, f"bit of byte {at}"
        assert told["damaged"] or not told["closed"]
        assert repair(path).whole
        kept = [message for message in raw(path) if message[0] != "/record/end"]
        # Nothing that stands in it is wrong, and no more than one chunk's worth is missing where that is named.
        assert set(kept) <= set(put)
        if told["closed"] and told["damaged"]:
            assert len(kept) > len(put) - 20
            assert (tmp_path / "record.mcap.damaged").read_bytes() == bad
        (tmp_path / "record.mcap.damaged").unlink(missing_ok=True)


def test_what_is_no_record_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "record.mcap"
    path.write_bytes(b"SQLite format 3\0" * 10)
    with pytest.raises(CellError, match="does not begin as an MCAP file does"):
        repair(path)
    assert path.read_bytes() == b"SQLite format 3\0" * 10
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ConfigError, match="there is no"):
        repair(tmp_path / "none.mcap")


KILLED = """
import sys, time
from pathlib import Path
from cell.run.record.file import RecordFile
out = RecordFile(Path(sys.argv[1]), {"run": "r"}, lossless=False)
for k in range(10_000):
    out.put("/sequence/event", k, lambda: b"{}")
    time.sleep(0.01)
    if k == 1:
        print("on", flush=True)
"""


def test_a_process_that_is_killed_leaves_all_but_its_last_seconds(tmp_path: Path) -> None:
    path = tmp_path / "record.mcap"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"on\n"
    until = time.monotonic() + 20.0
    while path.stat().st_size < 1000 and time.monotonic() < until:
        time.sleep(0.05)
    process.kill()
    process.wait()
    process.stdout.close()
    done = repair(path)
    assert not done.whole
    assert done.messages == len(raw(path)) > 10


def test_a_configuration_can_do_without_records(tmp_path: Path) -> None:
    quiet = CONFIG.model_copy(update={"cell": CONFIG.cell.model_copy(update={"record": False})})
    run: Run[None] = Run("jog", lambda run: None)
    with recorder.recorded(tmp_path, run, quiet, VirtualCell(CONFIG, 1, "ideal").devices) as record:
        assert record is None
    assert list(tmp_path.iterdir()) == []


def test_without_the_packages_that_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(record_file, "NEEDED", ("mcap", "no_such_package"))
    monkeypatch.setattr(recorder, "_said", set())
    cell = VirtualCell(CONFIG, 1, "ideal")
    run: Run[None] = Run("jog", lambda run: None)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert recorder.begin_record(tmp_path, run, CONFIG, cell.devices) is None
    assert [line.getMessage() for line in caplog.records if "no_such" in line.getMessage() or "no-such" in line.message]
    assert len(caplog.records) == 1
    with pytest.raises(CellError, match="pip install no-such-package"):
        list(messages(Path(__file__), ("/",)))


def test_a_recorder_that_fails_keeps_no_stop_and_no_command_from_passing(caplog: pytest.LogCaptureFixture) -> None:
    devices = VirtualCell(CONFIG, 1, "ideal").devices

    class Broken:
        def command(self, command: object, refused: str | None) -> None:
            raise OSError("no room")

        def reading(self, device: str, reading: object) -> None:
            raise OSError("no room")

    devices.gate.listener = Broken()
    devices.arm.state()
    devices.gate.listener = Broken()
    devices.rail.stop()
    assert devices.gate.listener is None
    assert sum("told nothing more" in line.getMessage() for line in caplog.records) == 2


# --- wires ---

FRAMES = (
    can.Message(arbitration_id=0x221, data=bytes(range(8)), is_extended_id=False),
    can.Message(arbitration_id=0x18FF50E5, data=b"\x01", is_extended_id=True),
    can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False),
    can.Message(arbitration_id=0x7FF, data=b"", is_extended_id=False),
)


def on_the_bus(path: Path) -> None:
    """A driver's link and another node on a virtual bus; all that passes goes into a record."""
    statistics = LinkStatistics()
    out = RecordFile(path, {}, lossless=True)
    count = iter(range(1, 1000))

    def listen(sent: bool, what: object) -> None:
        out.put("/vehicle/can", next(count) * 10**9 + 5_000, lambda: wire(sent, what))

    statistics.traffic.listener = listen
    link = CanLink(
        "vehicle", "virtual", str(path), bitrate=500_000, options={}, receive=lambda frame: None,
        idle=lambda seconds: None, statistics=statistics, alone="it stops",
    )  # fmt: skip
    other = can.Bus(interface="virtual", channel=str(path))
    try:
        for frame in FRAMES:
            link.send(frame, "a frame")
        for frame in FRAMES:
            other.send(frame)
        until = time.monotonic() + 5.0
        while next(count) < 0 or (len(out._waiting) + out.messages < 2 * len(FRAMES) and time.monotonic() < until):
            time.sleep(0.01)
    finally:
        link.close()
        other.shutdown()
    out.close()


def test_can_traffic_comes_back_from_candumps_format_as_it_passed(tmp_path: Path) -> None:
    on_the_bus(tmp_path / "record.mcap")
    assert as_candump(tmp_path / "record.mcap", tmp_path / "can.log") == 2 * len(FRAMES)
    with CanutilsLogReader(tmp_path / "can.log") as log:
        back = list(log)
    assert [frame.is_rx for frame in back] == [False] * len(FRAMES) + [True] * len(FRAMES)
    for frame, told in zip((*FRAMES, *FRAMES), back, strict=True):
        for name in ("arbitration_id", "data", "is_extended_id", "is_remote_frame", "dlc"):
            assert getattr(told, name) == getattr(frame, name)
    assert [frame.channel for frame in back] == ["can0"] * len(back)
    assert as_text(tmp_path / "record.mcap", tmp_path / "wires.txt") == 2 * len(FRAMES)
    lines = (tmp_path / "wires.txt").read_text(encoding="utf-8").splitlines()
    assert lines[0].endswith("/vehicle/can > 221 [8] 00 01 02 03 04 05 06 07")
    assert lines[6].endswith("/vehicle/can < 701 remote [1]")


def test_what_passes_between_arm_and_driver_has_words() -> None:
    assert json.loads(rtde(True, b"\x00\x05O\x01")) == {"sent": True, "data": "00054f01"}
    assert json.loads(rtde(False, "stop")) == {"sent": False, "text": "stop"}
    told = json.loads(rtde(True, ("output", (3, True, np.array([1.5, math.nan])))))
    assert told == {"sent": True, "request": "output", "arguments": [3, True, [1.5, None]]}


# --- replay ---


@pytest.fixture
def copied(folder: Path, tmp_path: Path) -> Iterator[Path]:
    """The run's folder, to be changed."""
    copy = tmp_path / folder.name
    shutil.copytree(folder, copy, ignore=lambda where, names: [n for n in names if n == "record.mcap"])
    yield copy


def test_perception_fed_again_gives_the_same_bits(folder: Path, placed_pot: JobRecord) -> None:
    compared = replay(folder)
    assert [each.difference for each in compared] == [""] * len(compared)
    names = [each.what for each in compared]
    assert names[:4] == ["board's pose", "cloud", "place pose", "its covariance"]
    assert int(names[4].split()[0]) == len(list((folder / "frames").iterdir()))


def test_a_pixel_or_a_reading_that_changed_is_found_and_exits_1(
    copied: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = json.loads((copied / PERCEPTION).read_text(encoding="utf-8"))
    kept["photograph"]["flange"][0] += 1e-9
    (copied / PERCEPTION).write_text(json.dumps(kept), encoding="utf-8")
    stripes = sorted((copied / "frames").glob("stripe-*.png"))
    middle = stripes[len(stripes) // 2]
    image = cv2.imread(str(middle), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(middle), np.roll(image, 1, axis=1))
    monkeypatch.setattr("sys.argv", ["cell", "replay", str(copied), "--json"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    told = json.loads(capsys.readouterr().out)
    assert not told["same"]
    by_name = {row["what"]: row["difference"] for row in told["compared"]}
    assert by_name["board's pose"].startswith("off by 1e-06 mm")
    assert "points" in by_name["cloud"]
    assert by_name["place pose"].startswith("off by")


def test_a_picture_of_the_record_that_is_not_the_file_is_found(folder: Path, tmp_path: Path) -> None:
    """Without the rest of perception: the run's folder has no pictures here."""
    from cell.run.record.replay import _pictures

    (tmp_path / "frames").mkdir()
    shutil.copy(folder / "record.mcap", tmp_path)
    for path in (folder / "frames").iterdir():
        shutil.copy(path, tmp_path / "frames")
    assert _pictures(tmp_path)[0].same
    victim = sorted((tmp_path / "frames").iterdir())[5]
    victim.write_bytes(victim.read_bytes()[:-1] + b"\0")
    assert _pictures(tmp_path)[0].difference == f"not those in frames/: {victim.name}"


def test_a_run_that_came_to_no_cloud_says_that_it_cannot_be_replayed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"holds no perception\.json"):
        replay(tmp_path)


# --- other readers and the documentation ---


def test_rerun_sees_frames_lenses_pictures_and_cloud(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    command = Path(sys.executable).with_name("rerun")
    out = tmp_path / "record.rrd"
    convert = [command, "mcap", "convert", folder / "record.mcap", "-o", out]
    subprocess.run(convert, check=True, capture_output=True, timeout=120)
    told = subprocess.run([command, "rrd", "print", out], check=True, capture_output=True, text=True, timeout=120)
    found: dict[str, str] = defaultdict(str)
    for line in (told.stdout + told.stderr).splitlines():
        if " - /" in line:
            found[line.split(" - ")[1].strip()] += line
    assert "Transform3D:parent_frame" in found["/tf"]
    assert "Points3D:positions" in found["/cloud/line"] and "Points3D:positions" in found["/cloud/grown"]
    for camera in ("scan_camera", "target_camera"):
        assert "EncodedImage:blob" in found[f"/{camera}/image"]
        assert "Pinhole:image_from_camera" in found[f"/{camera}/calibration"]
    assert "TextLog:text" in found["/log"]
