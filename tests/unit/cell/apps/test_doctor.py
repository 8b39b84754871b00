"""`cell doctor`: what is wrong with a computer is found, with what mends it, and only what the cell needs counts."""

import os
import pty
from importlib.metadata import PackageNotFoundError, version

import pytest

from cell.apps import doctor
from cell.apps.doctor import OWN, can_check, link_checks, package_checks, shadow_check
from cell.config.cell_config import DEVICES, load_config
from drivers.vehicle.health import CanInterface


def test_packages_are_held_against_the_pins():
    def installed(name: str) -> str:
        if name in ("canopen", "cascadio"):
            raise PackageNotFoundError(name)
        return "1.7.0" if name == "ur-rtde" else version(name)

    rows = package_checks(["canopen"], ["step"], installed)
    assert rows[0].state == "wrong"
    assert rows[0].found.startswith("ur-rtde is 1.7.0, asked for is ")
    assert rows[0].mend == "pip install 'ur-rtde<1.7,>=1.6.3'"
    assert (rows[1].state, rows[1].found) == ("wrong", "canopen is not installed")
    # What this cell does without is told, and is not wrong.
    assert (rows[2].state, rows[2].mend) == ("not needed", "pip install 'cascadio<0.2,>=0.1'")


def test_a_package_of_the_same_name_is_told(tmp_path):
    ours = {name: ["assembly-cell", "assembly-cell"] for name in OWN}
    assert shadow_check(lambda: ours).state == "ok"
    row = shadow_check(lambda: {**ours, "statemachine": ["assembly-cell", "python-statemachine"]})
    assert (row.state, row.mend) == ("wrong", "pip uninstall python-statemachine; pip install -e .")
    assert row.found.startswith("python-statemachine installs a package statemachine as well")
    assert shadow_check(lambda: ours, tmp_path).found.startswith("cell is imported from ")


def test_a_port_and_its_group(tmp_path, monkeypatch):
    config = load_config(None)
    others = [name for name in DEVICES if name != "rail"]
    (row,) = (row for row in link_checks(config, others, tmp_path) if row.state != "not needed")
    assert (row.what, row.state, row.found) == (f"rail, port {config.rail.place}", "wrong", "not there")
    master, port = pty.openpty()
    rail = config.rail.model_copy(update={config.rail.ADDRESS: os.ttyname(port)})
    monkeypatch.setattr("os.access", lambda *arguments: False)
    there = config.model_copy(update={"rail": rail})
    (row,) = (row for row in link_checks(there, others, tmp_path) if row.state != "not needed")
    assert row.found == "no permission"
    assert row.mend.startswith("sudo usermod -aG ")
    os.close(master)
    os.close(port)


@pytest.mark.parametrize(
    ("about", "verdict", "mend"),
    [
        (None, "wrong", "plug the adapter in; sudo ip link set can0 up type can bitrate 500000"),
        (CanInterface("can0", False), "wrong", "sudo ip link set can0 up type can bitrate 500000"),
        (CanInterface("can0", True, 250_000), "wrong", "sudo ip link set can0 down; sudo ip link set can0 up type"),
        (CanInterface("can0", True, 500_000), "ok", ""),
        # A virtual bus has no bit rate.
        (CanInterface("can0", True), "ok", ""),
    ],
)
def test_a_can_interface_against_the_configuration(about: CanInterface | None, verdict: str, mend: str):
    vehicle = load_config(None).vehicle.model_copy(update={"interface": "socketcan", "channel": "can0"})
    row = can_check("vehicle", vehicle, about)
    assert row.state == verdict
    assert row.mend.startswith(mend)


def test_room_clock_and_date(tmp_path):
    (tmp_path / "runs" / "20260101T000000-0001").mkdir(parents=True)
    assert doctor.disk_check(tmp_path / "runs" / "not" / "yet", wanted=0).state == "ok"
    row = doctor.disk_check(tmp_path / "runs", wanted=10**18)
    assert row.state == "wrong"
    assert row.mend.startswith(f"rm -r {tmp_path}/runs/20260101T000000-0001 ")
    source = tmp_path / "sys/devices/system/clocksource/clocksource0/current_clocksource"
    source.parent.mkdir(parents=True)
    for name, needed, verdict in (("tsc", True, "ok"), ("hpet", True, "wrong"), ("hpet", False, "not needed")):
        source.write_text(f"{name}\n")
        assert doctor.clock_check(tmp_path, needed).state == verdict
    for told, verdict in ((True, "ok"), (False, "wrong"), (None, "wrong")):
        assert doctor.date_check(told, needed=True).state == verdict
    for needed, verdict in ((True, "wrong"), (False, "not needed")):
        assert doctor.scheduling_check(tmp_path, needed, most=-1.0).state == verdict
