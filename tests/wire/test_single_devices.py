"""A command connects what it needs and no more: the rail is jogged, homed and looked at with the arm switched off."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cell.config import default_toml, load_config
from cell.devices.assembly import connect
from cell.run.lock import CellLock
from drivers.errors import InterlockError, NotConnectedError
from tests.packages import RAIL, install, with_acme_rail
from tests.wire.cells import ask, cell, served

pytestmark = pytest.mark.wire


def without_arm(folder: Path) -> None:
    """The served cell's configuration, with the arm where nobody listens."""
    toml = folder / "sim.toml"
    arm = load_config(toml).arm.place
    toml.write_text(toml.read_text().replace(f'"{arm}"', '"127.255.0.9"'))


def test_the_rail_works_while_the_arm_is_switched_off(tmp_path: Path) -> None:
    with served(tmp_path, "--seed", "3", "--level", "ideal") as endpoints:
        without_arm(tmp_path)
        done = cell("home", "rail", "-c", "sim.toml", folder=tmp_path)
        assert (done.returncode, done.stdout) == (0, "rail homed\n"), done.stderr
        done = cell("jog", "rail", "+5mm", "-c", "sim.toml", folder=tmp_path)
        assert done.returncode == 0, done.stderr
        assert ask(endpoints, op="truth")["truth"]["rail"]["carriage"] == pytest.approx(0.005, abs=1e-5)
        done = cell("diag", "--device", "rail", "-c", "sim.toml", "--json", folder=tmp_path)
        assert done.returncode == 0, done.stderr
        rows = json.loads(done.stdout)
        assert list(rows) == ["rail"]
        assert rows["rail"]["state"] == "homed, at 5.00 mm"
        done = cell("home", "-c", "sim.toml", folder=tmp_path)
        assert done.returncode == 1
        assert "127.255.0.9" in done.stderr


def test_only_the_device_that_is_used_is_held_and_no_other_can_be_asked(tmp_path: Path) -> None:
    with served(tmp_path, "--seed", "3"):
        config = load_config(tmp_path / "sim.toml")
        with CellLock(config, ["rail"]):
            with CellLock(config, ["vehicle"]):
                pass
            with pytest.raises(InterlockError, match="the rail at"), CellLock(config):
                pass
        devices = connect(config, ["rail"])
        assert [device.name for device in devices] == ["rail"]
        with pytest.raises(NotConnectedError, match="arm: this command works without it"):
            _ = devices.arm
        assert devices.stop() == devices.close() == []


def test_a_rail_of_another_maker_is_jogged_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = install(tmp_path / "site", "acme-rail", "1.2", "rail.acme = acme_rail:MAKE", acme_rail=RAIL)
    monkeypatch.setenv("PYTHONPATH", str(site), prepend=":")
    (tmp_path / "cell.toml").write_text(with_acme_rail(default_toml()).replace("192.0.2.", "10.255.255."))
    done = cell("jog", "rail", "+5mm", "--json", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["rail"] == "0.000 mm → 5.000 mm"
