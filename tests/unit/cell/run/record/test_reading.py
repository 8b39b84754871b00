"""Promises of `cell.run.record.reading`."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.apps.cli.commands import record as record_command
from cell.run.record.reading import information
from cell.run.record.repair import repair


def test_a_record_without_a_message_is_not_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "record.mcap"
    path.write_bytes(b"")
    assert not information(path)["whole"]
    assert not repair(path).whole
    told = information(path)
    assert (told["whole"], told["closed"], told["messages"]) == (False, True, 0)
    for command, says in (("info", "empty, it holds no message"), ("repair", "is closed and empty")):
        record_command.app([command, str(path)], standalone_mode=False)
        assert says in " ".join(capsys.readouterr().out.split())
