"""An address that cannot be one is refused with what it should look like; a right one passes as it was written."""

from collections.abc import Callable

import pytest

from drivers.common.addresses import (
    checked_can,
    checked_endpoint,
    checked_folder,
    checked_host,
    checked_name,
    checked_port,
)


@pytest.mark.parametrize(
    ("check", "text", "says"),
    [
        (checked_host, "300.1.2.3", "0 to 255"),
        (checked_host, "192.168.0", "four numbers"),
        (checked_host, "192.0.2.1O", "four numbers"),
        (checked_host, "arm one", "is no address"),
        (checked_host, "10.0.0.5:30004", "leave out port"),
        (checked_host, "http://10.0.0.5", "leave out port, scheme"),
        (checked_host, "0.0.0.0", "not the address of one device"),
        (checked_endpoint, "10.0.0.20:0", "1 to 65535"),
        (checked_endpoint, "10.0.0.20:five", "1 to 65535"),
        (checked_endpoint, "10.0.0.20", "has no port; write HOST:PORT"),
        (checked_endpoint, "10.0.0.256:5000", "0 to 255"),
        (checked_port, "", "no serial port; .*/dev/ttyUSB0"),
        (checked_port, "/dev/", "no serial port"),
        (checked_port, "/dev/../etc/passwd", "no serial port"),
        (checked_port, "telnet://10.0.0.5:4001", '"telnet" is not one of'),
        (checked_port, "socket://10.0.0.5", "has no port"),
        (checked_port, "socket://", "names no port"),
        (checked_port, "rfc2217://10.0.0.999:4001", "0 to 255"),
        (checked_name, "", "is no name"),
        (checked_name, "a/b", "no slash"),
        (checked_name, "two\nlines", "is no name"),
        (checked_folder, "/var/runs", "no absolute path"),
        (checked_folder, "../runs", 'no ".."'),
        (checked_folder, "~/store", "no folder beside this file"),
    ],
)
def test_what_is_no_address_is_refused(check: Callable[[str], str], text: str, says: str):
    with pytest.raises(ValueError, match=says):
        check(text)


@pytest.mark.parametrize(
    ("check", "text"),
    [
        (checked_host, "arm-1.factory.local"),
        (checked_port, "socket://10.0.0.5:4001"),
        (checked_port, "rfc2217://moxa:4001?logging=debug"),
        (checked_port, "COM3"),
        (checked_port, "/dev/serial/by-id/usb-Trinamic_TMCM-1110-if00"),
        (checked_folder, "data/runs 2026"),
        (checked_name, "pot no. 7_b"),
    ],
)
def test_a_right_address_passes_as_it_is(check: Callable[[str], str], text: str):
    assert check(text) == text


@pytest.mark.parametrize(
    ("interface", "channel", "kbit", "says"),
    [
        ("canfoo", "can0", 500, '"canfoo" is unknown; known are .*socketcan'),
        ("virtual", "can0", 500, "reaches no vehicle"),
        ("socketcan", "/dev/ttyUSB0", 500, '/dev/ttyUSB0.*"can0"'),
        ("pcan", "can0", 500, "PCAN_USBBUS1"),
        ("kvaser", "can0", 500, "a number"),
        ("socketcand", "can0", 500, "host and a port"),
        ("udp_multicast", "can0", 500, "multicast address"),
        ("slcan", "can0", 500, '"slcan".*no serial port'),
        ("slcan", "/dev/ttyUSB0@fast", 500, "no speed of a serial line"),
        ("slcan", "socket://10.0.0.5:0", 500, "1 to 65535"),
        ("slcan", "/dev/ttyUSB0", 123, "123 kbit/s.*500"),
    ],
)
def test_a_bus_that_cannot_be_is_refused(interface: str, channel: str, kbit: float, says: str):
    with pytest.raises(ValueError, match=says):
        checked_can(interface, channel, 1e3 * kbit)


@pytest.mark.parametrize("channel", ["/dev/ttyUSB0", "/dev/ttyUSB0@115200", "socket://10.0.0.6:3000"])
def test_a_bus_on_a_serial_line_or_a_socket_passes(channel: str):
    checked_can("slcan", channel, 500e3)
