"""Files that an earlier version wrote stay readable: a calibration, a journal, and a record that was cut short."""

from pathlib import Path

from cell.config.calibrations.store import read_calibration
from cell.procedures.steps.kinds import PLACE
from cell.run.record.reading import Parts, said
from statemachine.journal import read

KEPT = Path(__file__).with_name("kept")


def test_a_stored_calibration_is_read_and_its_digest_holds():
    calibration = read_calibration(KEPT / "calibration.json")
    assert calibration.identities["scan_camera"] == "SIM0000011-SCAN"
    assert calibration.edits == ()


def test_a_journal_tells_how_its_run_ended():
    record = read(KEPT)
    assert [run.outcome for run in record.runs] == ["placed"]
    assert [step.name for step in record.steps] == list(PLACE.names)


def test_a_record_gives_all_its_messages():
    told = Parts()
    topics = [message.topic for message in said(KEPT / "record.mcap", told)]
    assert (len(topics), len(set(topics))) == (84, 23)
    assert (told.closed, told.lost, told.damaged) == (True, 0, [])
