"""Promises of `cell.run.record.file`."""

import time

from cell.run.record import file as record_file
from cell.run.record.file import BY_TOPIC, CHANNELS, RecordFile
from cell.run.record.reading import information
from tests.support import ROOT


def test_what_comes_too_fast_is_counted_and_never_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(record_file, "MOST_WAITING", 50)
    out = RecordFile(tmp_path / "record.mcap", {}, lossless=False)
    begun = time.monotonic()
    for k in range(5000):
        out.put("/vehicle/can", k, lambda: b"{}")
    assert time.monotonic() - begun < 2.0
    out.close()
    told = information(out.path)
    assert told["dropped"] == dict(out.dropped)
    assert out.dropped["/vehicle/can"] + told["messages"] == 5001
    assert out.dropped["/vehicle/can"] > 0


def test_a_disk_that_takes_nothing_costs_the_record_and_not_the_run(tmp_path):
    out = RecordFile(tmp_path / "nowhere" / "record.mcap", {}, lossless=True)
    out.put("/vehicle/can", 0, lambda: b"{}")
    out.close()
    assert out.failure is not None and "nowhere" in out.failure


def test_the_documentation_lists_the_channels():
    text = (ROOT / "docs" / "reference" / "record.md").read_text(encoding="utf-8")
    rows = ["| channel | schema | what |", "|---|---|---|"]
    for channel in CHANNELS:
        of = f" ({', '.join(channel.devices)})" if channel.devices else ""
        rows.append(f"| `{channel.topic}`{of} | `{channel.schema}` | {channel.what} |")
    assert "\n".join(rows) in text
    assert len({topic for channel in CHANNELS for topic in channel.topics}) == len(BY_TOPIC)
