"""Promises of `drivers.vehicle.health`."""

import struct

import can
import pytest

from drivers.vehicle.agilex_link import load_database
from drivers.vehicle.health import CanInterface, most_bits, parse_interface, readings


def test_the_longest_can_frames_are_as_long_as_known():
    """Worst cases of the literature on response times (Davis et al. 2007): 55 + 10 n and 80 + 10 n bits."""
    for n in range(9):
        assert most_bits(can.Message(data=bytes(n), is_extended_id=False)) == 55 + 10 * n
        assert most_bits(can.Message(data=bytes(n), is_extended_id=True)) == 80 + 10 * n


LINK = (
    '[{"ifindex":4,"ifname":"can0","flags":["NOARP","UP","LOWER_UP","ECHO"],"link_type":"can","linkinfo":{"info_kind":'
    '"can","info_data":{"state":"ERROR-WARNING","berr_counter":{"tx":0,"rx":97},"restart_ms":0,"bittiming":{"bitrate":'
    '500000,"sample_point":"0.875"},"clock":24000000}}}]'
)


def test_what_linux_tells_of_a_can_interface_is_read_and_what_is_odd_is_not_made_up():
    assert parse_interface("can0", LINK) == CanInterface("can0", True, 500_000, "ERROR-WARNING", 0, 97)
    assert parse_interface("can1", LINK) is None
    virtual = '[{"ifname":"vcan0","flags":["NOARP"],"linkinfo":{"info_kind":"vcan"}}]'
    assert parse_interface("vcan0", virtual) == CanInterface("vcan0", False)
    for odd in ("", "{}", "[null]", '[{"ifname":"can0","linkinfo":null}', "no such device"):
        assert parse_interface("can0", odd) is None


def test_readings_are_of_the_vehicles_newest_frames_and_of_no_other_nodes():
    def frame(identifier: int, data: bytes, extended: bool = False) -> can.Message:
        return can.Message(arbitration_id=identifier, data=data, is_extended_id=extended)

    heard = [
        frame(0x361, struct.pack(">BBhhh", 99, 98, 245, -15, 450)),
        frame(0x361, struct.pack(">BBhhh", 12, 98, 245, -15, 253)),
        frame(0x361, b"\x7f" * 8, extended=True),
        frame(0x261, b"\x7f" * 8, extended=True),
        can.Message(arbitration_id=0x20000004, dlc=8, data=bytes(8), is_error_frame=True),
    ]
    told = readings([(0.1 * k, frame) for k, frame in enumerate(heard)], 0.5, 500_000, load_database(), None, True)
    found = {reading.what: reading for reading in told}
    assert (found["charge"].value, found["charge"].ok) == (12, False)
    assert found["battery's temperature"].value == pytest.approx(25.3)
    assert "hottest motor or its driver" not in found
    assert (found["error frames"].value, found["error frames"].ok) == (1, False)
