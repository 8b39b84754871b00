"""The composition root: which devices a command connects, and what becomes of them where one fails."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from cell.config.cell_config import load_config
from cell.devices.assembly import connect, connected_for, methods, refuse_replays, safe_off_outputs
from drivers.errors import ConfigError, NotConnectedError
from drivers.interfaces import Claw

CONFIG = load_config(None)


def test_what_hangs_on_the_arm_brings_the_arm_and_nothing_else():
    assert connected_for(CONFIG, ["laser"]) == connected_for(CONFIG, ["laser", "arm"])
    assert set(connected_for(CONFIG, ["laser"])) == {"arm", "laser"}
    assert connected_for(CONFIG, ["rail"]) == ["rail"]


def test_the_arms_own_process_switches_off_a_laser_that_hangs_on_it_and_no_other():
    assert safe_off_outputs(CONFIG) == (CONFIG.laser.output,)
    assert safe_off_outputs(CONFIG.model_copy(update={"laser": SimpleNamespace()})) == ()


def test_when_one_device_fails_those_that_were_connected_are_closed():
    closed: list[str] = []

    def otherwise(name: str, clock: object) -> Any:
        if name == "vehicle":
            raise NotConnectedError(name, "nothing answers there")
        return SimpleNamespace(close=lambda: closed.append(name))

    names = ("rail", "arm", "vehicle")
    with pytest.raises(NotConnectedError, match="nothing answers there"):
        connect(CONFIG, names, otherwise)
    before = connected_for(CONFIG, names)
    assert closed == before[: before.index("vehicle")][::-1]


def test_nothing_moves_beside_a_camera_that_shows_another_day():
    makes = {"scan_camera": SimpleNamespace(replays=True, name="folder"), "rail": SimpleNamespace(replays=False)}
    replaying = cast(Any, SimpleNamespace(make=lambda name: makes[name]))
    refuse_replays(replaying, ["scan_camera"])
    with pytest.raises(ConfigError, match=r'scan_camera\.driver = "folder" plays recorded pictures.*: rail cannot'):
        refuse_replays(replaying, ["scan_camera", "rail"])


def test_an_interface_is_asked_for_its_methods_and_not_for_its_properties():
    assert {"grip", "release", "stop", "close"} <= set(methods(Claw))
    assert "holding" not in methods(Claw)
