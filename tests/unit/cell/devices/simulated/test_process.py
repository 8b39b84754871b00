"""Scheduled faults: how they are written, and when they happen. That they do happen is shown with the whole job."""

import pytest

from cell.devices.simulated.process import Injection, Injector
from cell.procedures.steps.kinds import PLACE
from drivers.errors import ConfigError, DeviceFault
from sim_backends.direct import cell as direct
from sim_backends.faults import FAULT_NAMES
from statemachine.step import Event


def test_a_scheduled_fault_is_written_as_fault_step_and_share():
    assert Injection.parse("arm.protective_stop@laser_sweep:40%", PLACE.names) == Injection(
        "arm.protective_stop", "laser_sweep", 0.4
    )
    assert Injection.parse("can.bus_off@drive_to_target", PLACE.names) == Injection(
        "can.bus_off", "drive_to_target", 0.0
    )


def test_every_fault_that_is_known_can_be_scheduled_and_written_back():
    for name in FAULT_NAMES:
        assert str(Injection.parse(f"{name}@place:12.5%", PLACE.names)) == f"{name}@place:12.5%"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("laser_sweep", "write it as"),
        ("arm.explodes@laser_sweep:40%", "known: arm.protective_stop"),
        ("arm.protective_stop@dance:40%", "the steps are drive_to_target, board_photo"),
        ("arm.protective_stop@place:140%", "140 % is outside 0 % to 100 %"),
        ("arm.protective_stop@place:-1%", "write it as"),
    ],
)
def test_what_cannot_be_scheduled_is_refused_with_what_can(text: str, said: str):
    with pytest.raises(ConfigError, match=said):
        Injection.parse(text, PLACE.names)


def test_what_was_scheduled_and_did_not_happen_is_told_and_keeps_no_other_from_happening():
    caused: list[str] = []

    def cause(name: str) -> None:
        if name == "rail.reset":
            raise DeviceFault("rail", "rail.gone", "the world does not answer", recoverable=False, hint="")
        caused.append(name)

    texts = ("rail.reset@laser_sweep:10%", "arm.protective_stop@laser_sweep:40%", "rail.reset@place:50%")
    injector = Injector(cause, [Injection.parse(text, PLACE.names) for text in texts])
    injector(Event("progress", "laser_sweep", {"fraction": 0.5}))
    assert caused == ["arm.protective_stop"]
    assert set(injector.missed) == {texts[0], texts[2]}
    assert "could not be caused: " in injector.missed[texts[0]]
    assert "the world does not answer" in injector.missed[texts[0]]
    assert injector.missed[texts[2]] == "the run did not come that far"


def test_the_door_without_wires_has_every_fault_but_those_of_a_wire():
    assert set(direct.NAMES) | set(direct.ON_WIRES) == set(FAULT_NAMES)
    for name in direct.NAMES:
        direct.require(name)
    assert set(direct.ON_WIRES) == {
        "arm.late_states", "rail.drop_reply", "rail.late_reply", "can.bus_off", "can.foreign_commands",
        "can.second_vehicle", "can.refused_frames",
    }  # fmt: skip
    for name in direct.ON_WIRES:
        with pytest.raises(ValueError, match=r"fault of the wire.*use --clock wall"):
            direct.require(name)
