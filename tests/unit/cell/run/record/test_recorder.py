"""A run's record: what others' readers find in it, how it survives being cut off, and perception fed with it again."""

import json
import logging
import math
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from cell.devices.simulated.direct import VirtualCell
from cell.run.record import file as record_file
from cell.run.record import recorder
from cell.run.record.file import BY_TOPIC
from cell.run.record.reading import messages
from cell.run.record.recorder import rtde
from cell.run.runs import Run
from drivers.errors import CellError
from lab.bench.job.whole_job import JobRecord
from tests.support.report_runs import CONFIG
from tests.unit.cell.run.record.conftest import Messages


def test_the_libraries_own_reader_finds_every_channel_of_a_job_without_wires(read: Messages):
    assert set(read) <= set(BY_TOPIC)
    wires = {"/vehicle/can", "/arm/rtde", "/rail/serial", "/laser/serial", "/claw/serial"}
    # Nobody asks the laser itself during a job.
    assert set(BY_TOPIC) - set(read) == {*wires, "/laser/state"}
    for topic, found in read.items():
        schema = BY_TOPIC[topic].schema
        if schema.startswith("foxglove."):
            assert {type(message).DESCRIPTOR.full_name for _, message in found} == {schema}
    assert read["/record/end"] == [(read["/record/end"][0][0], {"dropped": {}, "cpu_s": None})]


def test_times_are_the_virtual_clocks(read: Messages, placed_pot: JobRecord):
    for stamp, frame in read["/scan_camera/frame"]:
        assert stamp == round(1e9 * (frame["host_time"] + 0.5 * frame["exposure"]))
    times = np.concatenate([swath.times for swath in placed_pot.results["laser_sweep"].swaths])
    lines = sorted(stamp for stamp, _ in read["/cloud/line"])
    assert np.abs(np.array(lines) - np.sort(np.round(1e9 * times))).max() <= 1


def test_the_sequence_its_commands_and_its_log_can_be_read_back(read: Messages):
    states = [message["to"] for _, message in read["/sequence/state"]]
    assert [*states[:3], states[-1]] == ["drive_to_target", "board_photo", "laser_sweep", "placed"]
    assert any(m["kind"] == "step_done" and m["step"] == "place" for _, m in read["/sequence/event"])
    assert [m["name"] for _, m in read["/claw/command"]] == ["release"]
    assert [m["name"] for _, m in read["/laser/command"]].count("lit") >= 1
    assert [m["name"] for _, m in read["/scan_camera/command"]][-2:] == ["stream", "stream ended"]
    assert "sweep" in [m["name"] for _, m in read["/rail/command"]]
    assert {message.level for _, message in read["/log"]} <= {2, 3}


def test_the_rails_readings_are_those_that_the_sweep_rests_on(read: Messages, placed_pot: JobRecord):
    (swath,) = placed_pot.results["laser_sweep"].swaths
    told = np.array([[m["stamp"], m["position"]] for _, m in read["/rail/state"]])
    told = told[np.argsort(told[:, 0], kind="stable")]
    assert np.abs(np.interp(swath.times, told[:, 0], told[:, 1]) - swath.rail).max() < 20e-6


def test_a_configuration_can_do_without_records(tmp_path):
    quiet = CONFIG.model_copy(update={"cell": CONFIG.cell.model_copy(update={"record": False})})
    run: Run[None] = Run("jog", lambda run: None)
    with recorder.recorded(tmp_path, run, quiet, VirtualCell(CONFIG, 1, "ideal").devices) as record:
        assert record is None
    assert list(tmp_path.iterdir()) == []


def test_without_the_packages_that_is_said_once(tmp_path, monkeypatch, caplog):
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


def test_a_recorder_that_fails_keeps_no_stop_and_no_command_from_passing(caplog):
    devices = VirtualCell(CONFIG, 1, "ideal").devices
    broken = Mock(command=Mock(side_effect=OSError("no room")), reading=Mock(side_effect=OSError("no room")))
    for use in (devices.arm.state, devices.rail.stop):
        devices.gate.listener = broken
        use()
        assert devices.gate.listener is None
    assert sum("told nothing more" in line.getMessage() for line in caplog.records) == 2


def test_what_passes_between_arm_and_driver_has_words():
    assert json.loads(rtde(True, b"\x00\x05O\x01")) == {"sent": True, "data": "00054f01"}
    assert json.loads(rtde(False, "stop")) == {"sent": False, "text": "stop"}
    told = json.loads(rtde(True, ("output", (3, True, np.array([1.5, math.nan])))))
    assert told == {"sent": True, "request": "output", "arguments": [3, True, [1.5, None]]}
