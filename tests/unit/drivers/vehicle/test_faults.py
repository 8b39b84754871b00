"""Promises of `drivers.vehicle.faults`."""

from drivers.vehicle.faults import driver_trouble, system_trouble


def test_each_bit_of_a_motors_driver_is_a_fault_but_the_two_that_say_it_works():
    told = {bit: driver_trouble(1, 1 << bit) for bit in range(8)}
    assert [bit for bit, words in told.items() if not words] == [6, 7]
    assert len({words for words in told.values() if words}) == 6
    assert told[5] == ("motor 1: driver fails",)


def test_that_commands_stayed_away_is_no_fault_of_a_vehicle_that_nobody_commands():
    assert system_trouble(0x0200, commanded=False) == ()
    assert system_trouble(0x0200, commanded=True) == ("commands stayed away",)
    assert system_trouble(0x0100, commanded=False) == ("a motor driver fails",)
