"""Promises of `drivers.rail.modbus.link`."""

from __future__ import annotations

import pytest
from pymodbus.framer import FramerRTU

from drivers.rail.modbus import link as modbus_link
from drivers.rail.modbus.link import Number, Rate


def test_frames_carry_the_checksum_that_pymodbus_computes() -> None:
    for frame in (bytes(range(n)) for n in range(2, 40)):
        assert modbus_link._crc(frame) == FramerRTU.compute_CRC(frame).to_bytes(2, "big")


@pytest.mark.parametrize("value", [0, 1, -1, 65_536, -70_000, 2**31 - 1, -(2**31)])
def test_a_number_of_two_registers_comes_back_in_either_order(value: int) -> None:
    high, low = Number(0, 2), Number(0, 2, high_first=False)
    assert high.decode(high.encode(value)) == value == low.decode(low.encode(value))
    assert high.encode(value) == low.encode(value)[::-1]
    with pytest.raises(ValueError, match="16 bits"):
        Number(0).encode(70_000)


def test_a_ramp_in_the_drives_unit_is_never_longer_than_reckoned() -> None:
    """v²/2a has to hold: the acceleration is rounded up, the time that stands for it down."""
    for unit in ("rpm/s", "1/6 rps/s", "counts/s^2", "ms to 1000 rpm"):
        rate = Rate(Number(0), unit)
        for turns in (0.7, 3.3, 41.7, 100.0, 777.7):
            assert rate.decode(rate.encode(turns, 4096), 4096) >= turns * (1 - 1e-12)
