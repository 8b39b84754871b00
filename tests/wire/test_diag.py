"""`cell diag` looks and touches nothing: what no device tells is "unknown", and all is afterwards as it was before."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.wire.cells import ask, cell, served

pytestmark = pytest.mark.wire

STAYS = ("laser_on", "digital_outputs", "rail_moving", "vehicle", "arm", "part")


def test_diag_tells_what_the_devices_tell_changes_nothing_and_fails_when_one_does(tmp_path: Path) -> None:
    with served(tmp_path, "--seed", "3") as endpoints:
        toml = (tmp_path / "sim.toml").rename(tmp_path / "cell.toml")
        before = ask(endpoints, op="truth")["truth"]
        # Without -c it is the configuration of the present folder.
        good = cell("diag", "--json", folder=tmp_path)
        after = ask(endpoints, op="truth")["truth"]
        toml.write_text(re.sub(r'url = "socket://[^"]*"', 'url = "socket://127.0.0.1:1"', toml.read_text()))
        bad = cell("diag", "--json", folder=tmp_path)
    assert good.returncode == 0, good.stderr
    rows = json.loads(good.stdout)
    assert set(rows) == {"arm", "rail", "vehicle", "scan_camera", "target_camera", "laser", "claw"}
    assert all(row["ok"] and np.isfinite(row["p99_ms"]) for row in rows.values())
    assert "brake unknown" in rows["vehicle"]["state"]
    assert rows["rail"]["state"].startswith("not homed")
    for name in STAYS:
        assert after[name] == before[name], name
    assert after["rail"]["carriage"] == before["rail"]["carriage"]
    assert bad.returncode == 1
    assert not json.loads(bad.stdout)["rail"]["ok"]
