"""Promises of `drivers.vehicle.cia402.make`."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from cell.config.cell_config import default_toml, load_config
from cell.makes import make_of
from drivers.errors import ConfigError
from drivers.vehicle.cia402 import make
from drivers.vehicle.cia402.make import CanopenVehicleConfig, look_at_nodes
from tests.support import ROOT
from tests.support.canopen_bench import WHEELS, Bench, frame


def test_the_page_prints_a_vehicle_that_is_valid(tmp_path):
    page = (ROOT / "docs" / "how-to" / "canopen.md").read_text(encoding="utf-8")
    printed = page.split("```toml\n")[1].split("```")[0]
    text = default_toml()
    path = tmp_path / "cell.toml"
    path.write_text(text[: text.index("[vehicle]")] + printed + "\n" + text[text.index("[scan_camera]") :])
    record = load_config(path).vehicle
    assert isinstance(record, CanopenVehicleConfig)
    assert record.wheels() == WHEELS
    keys = set(re.findall(r"`(\w+)`", page))
    assert set(CanopenVehicleConfig.model_fields) - {"lean_sigma"} <= keys | set(re.findall(r"(?m)^(\w+) =", printed))


def table(**changed: str) -> str:
    keys = {
        "driver": '"canopen"', "interface": '"socketcan"', "channel": '"can0"', "bitrate": '"500 kbit/s"',
        "left_node": "1", "right_node": "2", "track": '"580 mm"', "wheel_radius": '"100 mm"', "gear": "20",
        "counts_per_turn": "4096", "velocity_unit": '"0.1 rpm"', "acceleration": '"0.5 m/s^2"',
        "deceleration": '"1 m/s^2"', "max_speed": '"0.5 m/s"', "max_yaw_rate": '"30 deg/s"',
    }  # fmt: skip
    return "[vehicle]\n" + "\n".join(f"{key} = {value}" for key, value in (keys | changed).items()) + "\n\n"


def config(tmp_path: Path, **changed: str) -> CanopenVehicleConfig:
    text = default_toml()
    begin, end = text.index("[vehicle]"), text.index("[scan_camera]")
    path = tmp_path / "cell.toml"
    path.write_text(text[:begin] + table(**changed) + text[end:])
    record = load_config(path).vehicle
    assert isinstance(record, CanopenVehicleConfig)
    return record


def test_a_configuration_describes_the_drives(tmp_path):
    assert config(tmp_path).wheels() == replace(WHEELS, stop_input=None)
    assert config(tmp_path, stop_input="3").wheels().stop_input == 3
    output = config(tmp_path, brake='"output"', brake_bit="17", brake_locks='"high"').wheels()
    assert (output.brake_output, output.brake_locks) == (17, True)
    assert make_of("vehicle", "canopen").missing() == ""


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"right_node": "1"}, "left_node 1, right_node 1 and own_node 127: each node"),
        ({"left_node": "128"}, "1 to 127"),
        ({"velocity_unit": '"rpm"', "gear": "1"}, "10.5 mm/s at the wheel .*at most 2 mm/s"),
        ({"counts_per_turn": "4"}, "per count .*at most 0.5 mm"),
        ({"gear": "900"}, "turns a minute of a motor"),
        ({"watchdog": '"5 s"'}, "100 to 1000"),
        ({"wheel_radius": "100"}, "mm"),
    ],
)
def test_what_cannot_be_is_refused_with_its_range(tmp_path, changed: dict[str, str], told: str):
    with pytest.raises(ConfigError, match=told):
        config(tmp_path, **changed)


@pytest.mark.wire
def test_the_nodes_of_a_bus_are_found_by_one_question_each_and_the_others_only_heard(
    apart: Bench, tmp_path, monkeypatch
):
    """Neither a network command nor anything for a node that the configuration does not name is sent."""
    monkeypatch.setattr(make, "LISTEN_S", 0.8)
    record = config(tmp_path).model_copy(update={"interface": "virtual", "channel": apart.channel})
    with apart.other() as other:
        sender = other.send_periodic(frame(0x709, b"\x05"), 0.5)
        text, ok = look_at_nodes(record)
        monkeypatch.setattr(make, "LISTEN_S", 0.1)
        missing, found = look_at_nodes(record.model_copy(update={"right_node": 7}))
        taken = look_at_nodes(record.model_copy(update={"own_node": 1, "left_node": 2, "right_node": 1}))
        sender.stop()
    assert ok
    assert text == (
        "node 1 answers: profile 402 (vendor 0x31f, product 0x192); node 2 answers: profile 402 (vendor 0x31f, "
        "product 0x192); heard besides: node 9"
    )
    assert not found and "node 7 does not answer: see its number" in missing
    assert not taken[1] and "node 1, which is to be this program's, is taken" in taken[0]
    assert {message.arbitration_id for message in apart.bus.frames} == {0x601, 0x602, 0x607, 0x709}
