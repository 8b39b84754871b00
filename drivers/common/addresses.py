"""Where devices are, as text: host names, ports, serial lines, CAN channels; and names of files and folders.

Only the form is checked here: whether somebody answers is seen when the device is connected.
"""

import ipaddress
import re
from urllib.parse import urlsplit

from pydantic import AfterValidator

from drivers.common.units import shown

_LABEL = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?<!-)")
_PORT_FILE = re.compile(r"/dev/[^\s/][^\s]*[^\s/]|/dev/[^\s/]|COM[1-9]\d{0,2}")
_LINKS = ("socket", "rfc2217")
_SCHEMES = (*_LINKS, "alt", "spy", "hwgrep", "cp2110")
_PORT_FORM = 'write a device such as "/dev/ttyUSB0" or "COM3", or a pyserial URL such as "socket://10.0.0.5:4001"'
_EXAMPLES = tuple(ipaddress.ip_network(net) for net in ("192.0.2.0/24", "198.51.100.0/24", "203.0.113.0/24"))

_SERIAL_CAN = ("slcan", "serial", "robotell", "seeedstudio")
_CHANNELS = {
    "socketcan": (r"[A-Za-z][A-Za-z0-9_.-]{0,14}", 'the name of a network interface, such as "can0"'),
    "pcan": (r"PCAN_(ISA|DNG|PCI|USB|PCC|LAN)BUS\d{1,2}", 'a name such as "PCAN_USBBUS1"'),
    **dict.fromkeys(("kvaser", "ixxat", "cantact", "iscan", "vector"), (r"\d{1,3}", 'a number, such as "0"')),
}
_SLCAN_KBIT = (10, 20, 50, 83.3, 100, 125, 250, 500, 750, 1000)


def checked_host(text: str) -> str:
    """A host's name or IPv4 address; `ValueError` says what it should look like."""
    form = 'write an IPv4 address such as "10.0.0.5" or a host\'s name'
    if re.fullmatch(r"[0-9.]+|([0-9]+\.){3}\w+", text):
        try:
            found = ipaddress.IPv4Address(text)
        except ValueError as error:
            raise ValueError(f"{shown(text)} is no address: four numbers from 0 to 255 are needed; {form}") from error
        if found.is_unspecified or found.is_multicast or found == ipaddress.IPv4Address("255.255.255.255"):
            raise ValueError(f"{shown(text)} is not the address of one device; {form}")
        return text
    if ":" in text or "/" in text:
        raise ValueError(f"{shown(text)} is more than an address; leave out port, scheme and path: {form}")
    if len(text) > 253 or not all(_LABEL.fullmatch(label) for label in text.split(".")):
        raise ValueError(f"{shown(text)} is no address; {form}")
    return text


def checked_endpoint(text: str) -> str:
    """HOST:PORT; `ValueError` says what is wrong with it."""
    host, colon, port = text.rpartition(":")
    if not colon or not host:
        raise ValueError(f'{shown(text)} has no port; write HOST:PORT, such as "10.0.0.5:5000"')
    checked_host(host)
    if not re.fullmatch(r"\d{1,7}", port, re.ASCII) or not 1 <= int(port) <= 65535:
        raise ValueError(f"{shown(text)}: port {shown(port)} is outside the allowed range (allowed: 1 to 65535)")
    return text


def checked_port(text: str) -> str:
    """A serial port: a device's path, or a URL of a kind that pyserial knows; `ValueError` says what is wrong."""
    if "://" not in text:
        if not _PORT_FILE.fullmatch(text) or ".." in text.split("/"):
            raise ValueError(f"{shown(text)} is no serial port; {_PORT_FORM}")
        return text
    scheme, _, rest = text.partition("://")
    if scheme not in _SCHEMES:
        raise ValueError(f"{shown(text)}: {shown(scheme)} is not one of {', '.join(_SCHEMES)}; {_PORT_FORM}")
    if not rest or re.search(r"\s", rest):
        raise ValueError(f"{shown(text)} names no port; {_PORT_FORM}")
    if scheme in _LINKS:
        try:
            checked_endpoint(urlsplit(text).netloc)
        except ValueError as error:
            raise ValueError(f"{shown(text)}: {error}") from error
    return text


def checked_can(interface: str, channel: str, bitrate: float) -> None:
    """`ValueError` when python-can has no such interface, or the channel or the bit rate is none of that interface."""
    import can

    if interface not in can.VALID_INTERFACES:
        raise ValueError(
            f"interface {shown(interface)} is unknown; known are {', '.join(sorted(can.VALID_INTERFACES))}"
        )
    if interface == "virtual":
        raise ValueError('interface "virtual" reaches no vehicle; `cell sim serve` simulates one on "slcan"')
    if interface == "socketcand":
        raise ValueError('interface "socketcand" needs a host and a port, which cannot be given here; use "socketcan"')
    if interface in _SERIAL_CAN:
        port, _, baud = channel.partition("@")
        try:
            checked_port(port)
        except ValueError as error:
            raise ValueError(f'channel for interface "{interface}": {error}') from error
        if "@" in channel and not re.fullmatch(r"\d{3,8}", baud):
            raise ValueError(f"channel {shown(channel)}: {shown(baud)} is no speed of a serial line, such as 115200")
    elif interface == "udp_multicast":
        if not _is_multicast(channel):
            raise ValueError(f'channel {shown(channel)} is no multicast address, such as "239.74.163.2"')
    else:
        pattern, form = _CHANNELS.get(interface, (r"\S+", "a name without blanks"))
        if not re.fullmatch(pattern, channel):
            raise ValueError(f'channel {shown(channel)} does not fit interface "{interface}": it takes {form}')
    if interface == "slcan" and not any(abs(bitrate - 1e3 * kbit) < 1 for kbit in _SLCAN_KBIT):
        rates = ", ".join(f"{kbit:g}" for kbit in _SLCAN_KBIT)
        raise ValueError(f'bitrate {1e-3 * bitrate:g} kbit/s is none of interface "slcan" (allowed: {rates} kbit/s)')


def _is_multicast(text: str) -> bool:
    try:
        return ipaddress.ip_address(text).is_multicast
    except ValueError:
        return False


def is_example(address: str) -> bool:
    """Whether an address (HOST or HOST:PORT) is one of those that are kept for examples: nobody has it."""
    try:
        host = ipaddress.IPv4Address(address.partition(":")[0])
    except ValueError:
        return False
    return any(host in net for net in _EXAMPLES)


def checked_name(text: str) -> str:
    """A name that can be a file's as well; `ValueError` says what it may hold."""
    if not re.fullmatch(r"\w([\w .+-]{0,62}[\w+-])?", text):
        raise ValueError(f"{shown(text)} is no name: 1 to 64 letters, digits, blanks and . _ + - are allowed, no slash")
    return text


def checked_folder(text: str) -> str:
    """A folder beside the configuration; `ValueError` when the name leads elsewhere."""
    parts = text.split("/")
    if not text or text.startswith(("/", "~")) or "\\" in text or any(part in ("", ".", "..") for part in parts):
        raise ValueError(
            f'{shown(text)} is no folder beside this file: write a name such as "runs", no absolute path and no ".." '
            "(where another disk is wanted, make the folder a link to it)"
        )
    for part in parts:
        checked_name(part)
    return text


Host = AfterValidator(checked_host)
Endpoint = AfterValidator(checked_endpoint)
Port = AfterValidator(checked_port)
Name = AfterValidator(checked_name)
Folder = AfterValidator(checked_folder)
