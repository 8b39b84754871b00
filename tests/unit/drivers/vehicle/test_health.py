"""Promises of `drivers.vehicle.health`."""

from __future__ import annotations

import can

from drivers.vehicle.health import CanInterface, most_bits, parse_interface


def test_the_longest_can_frames_are_as_long_as_known() -> None:
    """Worst cases of the literature on response times (Davis et al. 2007): 55 + 10 n and 80 + 10 n bits."""
    for n in range(9):
        assert most_bits(can.Message(data=bytes(n), is_extended_id=False)) == 55 + 10 * n
        assert most_bits(can.Message(data=bytes(n), is_extended_id=True)) == 80 + 10 * n


LINK = (
    '[{"ifindex":4,"ifname":"can0","flags":["NOARP","UP","LOWER_UP","ECHO"],"link_type":"can","linkinfo":{"info_kind":'
    '"can","info_data":{"state":"ERROR-WARNING","berr_counter":{"tx":0,"rx":97},"restart_ms":0,"bittiming":{"bitrate":'
    '500000,"sample_point":"0.875"},"clock":24000000}}}]'
)


def test_what_linux_tells_of_a_can_interface_is_read_and_what_is_odd_is_not_made_up() -> None:
    assert parse_interface("can0", LINK) == CanInterface("can0", True, 500_000, "ERROR-WARNING", 0, 97)
    assert parse_interface("can1", LINK) is None
    virtual = '[{"ifname":"vcan0","flags":["NOARP"],"linkinfo":{"info_kind":"vcan"}}]'
    assert parse_interface("vcan0", virtual) == CanInterface("vcan0", False)
    for odd in ("", "{}", "[null]", '[{"ifname":"can0","linkinfo":null}', "no such device"):
        assert parse_interface("can0", odd) is None
