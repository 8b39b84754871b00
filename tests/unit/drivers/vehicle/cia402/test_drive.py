"""Promises of `drivers.vehicle.cia402.drive`."""

import pytest

from drivers.vehicle.cia402.drive import DriveState, leads_to_enabled, leads_to_switched_on, may_turn, meaning, state_of


@pytest.mark.parametrize(
    ("statusword", "state", "turns"),
    [
        # As makers' manuals print them, with voltage, remote and their own bits set.
        (0x0250, DriveState.DISABLED, False),
        (0x0231, DriveState.READY, False),
        (0x0233, DriveState.SWITCHED_ON, False),
        (0x1637, DriveState.ENABLED, True),
        (0x0217, DriveState.QUICK_STOP, True),
        (0x021F, DriveState.REACTING, True),
        (0x0238, DriveState.FAULT, False),
        (0x0200, DriveState.NOT_READY, False),
    ],
)
def test_a_statusword_tells_the_state(statusword: int, state: DriveState, turns: bool):
    assert state_of(statusword) is state
    assert may_turn(state) is turns


def test_the_way_through_the_states():
    assert leads_to_enabled(DriveState.FAULT, 0x0F) == 0x00
    assert leads_to_enabled(DriveState.FAULT, 0x00) == 0x80  # a rising edge, seen apart
    assert [leads_to_enabled(s, 0) for s in (DriveState.DISABLED, DriveState.READY, DriveState.SWITCHED_ON)] == [
        6,
        7,
        15,
    ]
    assert leads_to_switched_on(DriveState.ENABLED, 15) == 0x07


def test_an_emergency_has_words_and_a_remedy_and_an_unknown_one_its_range():
    assert meaning(0x8130) == (
        "our heartbeat stayed away, 8130h: see what keeps this computer busy, or raise vehicle.watchdog"
    )
    assert meaning(0x7305).startswith("the encoder fails, 7305h: check the encoder's cable")
    assert meaning(0x2399) == "current, 2399h: see the drive's manual"
    assert meaning(0xFF07) == "a fault of its maker's own, FF07h: see the drive's manual"
