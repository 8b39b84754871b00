"""Promises of `cell.run.record.reading`."""

import subprocess
import sys
from pathlib import Path

import can
import numpy as np
import pytest
from can.io.canutils import CanutilsLogReader
from mcap.reader import make_reader

from cell.apps.cli.commands.runs import record
from cell.run.record import file as record_file
from cell.run.record.file import RecordFile
from cell.run.record.reading import as_candump, as_text, information, repair
from cell.run.record.recorder import as_json, wire
from drivers.errors import CellError, ConfigError
from drivers.interfaces import LinkStatistics
from drivers.vehicle.can_link import CanLink
from tests.support import until


def test_a_record_without_a_message_is_not_whole(tmp_path, capsys):
    path = tmp_path / "record.mcap"
    path.write_bytes(b"")
    assert not information(path)["whole"]
    assert not repair(path).whole
    told = information(path)
    assert (told["whole"], told["closed"], told["messages"]) == (False, True, 0)
    for command, says in (("info", "empty, it holds no message"), ("repair", "is closed and empty")):
        record([command, str(path)], standalone_mode=False)
        assert says in " ".join(capsys.readouterr().out.split())


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


def test_a_record_cut_off_anywhere_is_closed_with_all_that_is_whole(tmp_path, monkeypatch):
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


def test_a_flipped_bit_anywhere_is_named_and_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(record_file, "CHUNK_BYTES", 700)
    put = written(tmp_path / "whole.mcap")
    assert information(tmp_path / "whole.mcap")["whole"]
    data, path = (tmp_path / "whole.mcap").read_bytes(), tmp_path / "record.mcap"
    rng = np.random.default_rng(5)
    for at in rng.choice(len(data), 200, replace=False).tolist():
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


def test_what_is_no_record_is_left_as_it_is(tmp_path):
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
        print("on", flush=True)"""


def test_a_process_that_is_killed_leaves_all_but_its_last_seconds(tmp_path):
    path = tmp_path / "record.mcap"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"on\n"
    assert until(lambda: path.stat().st_size >= 1000, 20.0)
    process.kill()
    process.wait()
    process.stdout.close()
    done = repair(path)
    assert not done.whole
    assert done.messages == len(raw(path)) > 10


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
        "vehicle", "virtual", str(path), bitrate=500_000, receive=lambda frame: None,
        idle=lambda seconds: None, statistics=statistics, alone="it stops",
    )  # fmt: skip
    other = can.Bus(interface="virtual", channel=str(path))
    try:
        for frame in FRAMES:
            link.send_frame(frame, "a frame")
        for frame in FRAMES:
            other.send(frame)
        assert until(lambda: len(out._waiting) + out.messages >= 2 * len(FRAMES), 5.0)
    finally:
        link.close()
        other.shutdown()
    out.close()


def test_can_traffic_comes_back_from_candumps_format_as_it_passed(tmp_path):
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
