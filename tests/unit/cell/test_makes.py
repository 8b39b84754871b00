"""Makes of devices: `driver` chooses one, packages bring more, and what is wrong with one harms no other."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from cell.config.cell_config import CellConfig, default_toml, load_config
from cell.devices.assembly import connect_one, safe_off_outputs
from cell.devices.simulated.process import with_endpoints
from cell.makes import BUILT_IN, installed
from drivers.clock import Clock
from drivers.errors import ConfigError
from drivers.interfaces import Rail
from drivers.make import KINDS
from drivers.rail.tmcl.make import TmclRailConfig
from tests.support.packages import RAIL, install, with_acme_rail

OTHER = """
from typing import Literal
from cell.makes import BUILT_IN
from {module} import {record}
from drivers.make import Make

class OtherConfig({record}):
    driver: Literal["other"] = "other"

MAKE = Make("{kind}", "other", OtherConfig, BUILT_IN[{k}].connect, {more})
"""
"""A make with a built-in one's record, from another package."""


@pytest.fixture
def site(tmp_path, monkeypatch) -> Path:
    """Where packages are installed: a folder on this program's path, outside the repository."""
    folder = tmp_path / "site"
    install(folder, "acme-rail", "1.2", "rail.acme = acme_rail:MAKE", acme_rail=RAIL)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "acme_rail", raising=False)
    return folder


def loaded(folder: Path, **changes: str) -> CellConfig:
    path = folder / "acme.toml"
    path.write_text(with_acme_rail(default_toml(), **changes))
    return load_config(path)


def test_every_kind_has_a_built_in_make_which_is_taken_when_none_is_named(tmp_path):
    assert {make.kind for make in BUILT_IN} == set(KINDS)
    path = tmp_path / "cell.toml"
    path.write_text("\n".join(line for line in default_toml().splitlines() if not line.startswith("driver")))
    config = load_config(path)
    assert isinstance(config.rail, TmclRailConfig)
    assert config == load_config(None)


def test_a_calibration_made_before_there_were_makes_still_fits():
    assert load_config(None).calibration_hash() == "3bf8e26c4fda6b11"


def test_a_package_outside_brings_a_make_that_a_configuration_can_name(site: Path, tmp_path):
    config = loaded(tmp_path)
    rail: Rail = connect_one(config, "rail", Clock())
    assert rail.identity().model == "Acme belt rail"
    rail.home().wait(1.0)
    rail.move_to(0.02).wait(1.0)
    assert rail.state().position == 0.02
    assert config.model_dump(mode="json")["rail"]["port"] == "/dev/acme0"
    assert [row.source for row in installed() if row.make == "acme"] == ["acme-rail 1.2"]


def test_what_a_calibration_depends_on_comes_from_the_make(site: Path, tmp_path):
    own = loaded(tmp_path).calibration_hash()
    assert own != load_config(None).calibration_hash()
    assert loaded(tmp_path, port="/dev/acme1").calibration_hash() == own
    assert loaded(tmp_path, belt="3 mm").calibration_hash() != own


@pytest.mark.parametrize(
    ("kind", "k", "module", "record", "more"),
    [
        ("rail", 0, "drivers.rail.tmcl.make", "TmclRailConfig", "BUILT_IN[0].calibrated"),
        # No calibration depends on its values.
        ("laser", 4, "drivers.arm.make", "ArmOutputLaserConfig", "on_arm=True"),
    ],
)
def test_a_calibration_of_one_make_does_not_fit_another_with_the_same_values(
    site: Path, tmp_path, kind: str, k: int, module: str, record: str, more: str
):
    text = OTHER.format(kind=kind, k=k, module=module, record=record, more=more)
    install(site, "other", "1.0", f"{kind}.other = other_{kind}:MAKE", **{f"other_{kind}": text})
    before, table, after = default_toml().partition(f"\n[{kind}]")
    path = tmp_path / "other.toml"
    path.write_text(before + table + re.sub(r'(?m)^driver = "\w+"', 'driver = "other"', after, count=1))
    own, other = load_config(None), load_config(path)
    assert other.device(kind).driver == "other"
    assert other.device(kind).model_dump(exclude={"driver"}) == own.device(kind).model_dump(exclude={"driver"})
    assert other.calibration_hash() != own.calibration_hash()
    assert safe_off_outputs(other) == (own.laser.output,)


def test_its_values_are_checked_as_those_of_the_built_in_ones(site: Path, tmp_path):
    with pytest.raises(ConfigError, match=r"rail\.belt: .*1 to 10 mm"):
        loaded(tmp_path, belt="30 mm")
    with pytest.raises(ConfigError, match=r'rail\.port and vehicle\.channel are both "/dev/ttyUSB0"'):
        loaded(tmp_path, port="/dev/ttyUSB0")


def test_a_make_that_nothing_simulates_is_refused_in_a_simulated_cell(site: Path, tmp_path):
    with pytest.raises(ConfigError, match=r'rail\.driver = "acme": nothing simulates this make'):
        with_endpoints(loaded(tmp_path), {"speed": 1.0, "truth": {"address": "127.0.0.1:1"}, "arm": {"address": "x"}})


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("import not_there", "ModuleNotFoundError: No module named 'not_there'"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("MAKE = 7", "is no Make but of type int"),
        (RAIL.replace('"rail", "acme"', '"rail", "other"'), 'says that it is "rail.other"'),
        (RAIL.replace("(RailConfig)", "(__import__('pydantic').BaseModel)"), "does not derive from RailConfig"),
        (RAIL.replace('{"belt"}', '{"chain"}'), "its record has no chain"),
        (RAIL.replace('frozenset({"belt"})', "frozenset(), on_arm=True"), "does not derive from OnArm"),
    ],
    ids=["import", "exit", "no make", "another name", "another record", "unknown key", "on the arm"],
)
def test_a_broken_package_is_listed_with_its_error_and_stops_nothing(site: Path, tmp_path, module: str, words: str):
    (site / "acme_rail.py").write_text(module)
    rows = {(row.kind, row.make): row for row in installed()}
    assert rows["rail", "acme"].state.startswith("broken: ")
    assert words in rows["rail", "acme"].state
    # Not every machine has the library of every make.
    assert all(rows[make.kind, make.name].state.startswith(("ok", "not installed: ")) for make in BUILT_IN)
    assert load_config(None).rail.driver == "tmcl"
    with pytest.raises(ConfigError) as caught:
        loaded(tmp_path)
    assert "rail.driver" in str(caught.value) and words in str(caught.value)


def test_a_package_cannot_take_the_name_of_a_built_in_make(site: Path):
    install(site, "evil-rail", "6.6", "rail.tmcl = evil_rail:MAKE", evil_rail="raise SystemExit('was imported')")
    found = [row for row in installed() if row.make == "tmcl"]
    assert [(row.source, row.state.partition(":")[0]) for row in found] == [
        ("built in", "ok"),
        ("evil-rail 6.6", "refused"),
    ]
    assert type(load_config(None).rail) is TmclRailConfig


def test_of_two_packages_with_one_name_neither_is_taken(site: Path, tmp_path):
    install(site, "other-rail", "0.1", "rail.acme = other_rail:MAKE", other_rail=RAIL)
    assert {row.source: row.state for row in installed() if row.make == "acme"} == {
        "acme-rail 1.2": "refused: other-rail 0.1 brings a make of this name as well",
        "other-rail 0.1": "refused: acme-rail 1.2 brings a make of this name as well",
    }
    with pytest.raises(ConfigError, match=r"other-rail 0\.1 brings a make of this name as well"):
        loaded(tmp_path)


def test_an_unknown_driver_is_refused_with_what_is_installed(site: Path, tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(default_toml().replace('driver = "tmcl"', 'driver = "plc"'))
    with pytest.raises(ConfigError, match=r'rail\.driver: "plc" is not one of "tmcl" or "modbus" or "acme"'):
        load_config(path)


def test_the_command_lists_what_is_installed_with_its_source(site: Path, tmp_path):
    install(site, "lost", "0.0.1", "camera = lost:MAKE\nsonar.ping = lost:MAKE", lost="")
    path = os.pathsep.join((str(site), *sys.path))
    done = subprocess.run(
        [sys.executable, "-c", "from cell.apps.cli import main; main()", "devices", "--json"],
        env={**os.environ, "PYTHONPATH": path}, cwd=tmp_path, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert {"kind": "rail", "make": "acme", "source": "acme-rail 1.2", "state": "ok"} in rows
    assert {"kind": "rail", "make": "tmcl", "source": "built in", "state": "ok"} in rows
    assert [row["state"].partition(":")[0] for row in rows if row["source"] == "lost 0.0.1"] == ["refused", "refused"]


ARM = """
from typing import Annotated, Literal
from drivers.make import ArmConfig
from drivers.arm.make import UrArmConfig
from drivers.make import Make
from drivers.interfaces import LinkStatistics


class OldArmConfig(UrArmConfig):
    driver: Literal["old"] = "old"


class OldArm:
    closed = 0

    def __init__(self, name):
        self.name, self.statistics = name, LinkStatistics()

    def close(self):
        OldArm.closed += 1

    def _same(self, *given, **named):
        raise AssertionError("nothing is asked of it")

    identity = ping = stop = state = record = latch_clock = move_joints = move_linear = follow = _same
    zero_force = set_payload = set_digital_output = digital_input = recover = _same


MAKE = Make("arm", "old", OldArmConfig, lambda name, config, around: OldArm(name))
"""
"""An arm that was written before arms told their kinematics."""


def test_an_arm_that_lacks_a_method_is_named_with_it_and_closed(site: Path, tmp_path):
    install(site, "old-arm", "0.9", "arm.old = old_arm:MAKE", old_arm=ARM)
    path = tmp_path / "old.toml"
    path.write_text(default_toml().replace('driver = "ur"', 'driver = "old"'))
    with pytest.raises(ConfigError, match=r'the arm "old" has no link_table, which every arm must have'):
        connect_one(load_config(path), "arm", Clock())
    assert sys.modules["old_arm"].OldArm.closed == 1
