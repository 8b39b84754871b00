"""The raw traffic of a record for other programs: CAN as candump writes it, all wires as text."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from cell.run.record.reading import messages

ERROR_FLAG = 0x20000000
CAN, WIRES = "/vehicle/can", ("/vehicle/can", "/arm/rtde", "/rail/serial", "/laser/serial", "/claw/serial")


def as_candump(record: Path, out: Path, bus: str = "can0") -> int:
    """Write the CAN frames in candump's log format, with R for those that came and T for those sent; their number."""
    count = 0
    with out.open("w", encoding="ascii") as file:
        for _, at, told in messages(record, (CAN,)):
            way = "T" if told["sent"] else "R"
            file.write(f"({at // 10**9}.{at % 10**9 // 1000:06d}) {bus} {candump_frame(told)} {way}\n")
            count += 1
    return count


def candump_frame(told: dict[str, Any]) -> str:
    """A frame as candump's log has it. Source: `sprint_canframe` of can-utils and the headers of SocketCAN."""
    if told["error"]:
        return f"{ERROR_FLAG | told['id']:08X}#{told['data'].upper()}"
    number = f"{told['id']:08X}" if told["extended"] else f"{told['id']:03X}"
    if told["remote"]:
        # The length that is asked for; none stands for 0.
        return f"{number}#R{told['dlc'] or ''}"
    return f"{number}#{'#0' if told['fd'] else ''}{told['data'].upper()}"


def as_text(record: Path, out: Path) -> int:
    """Write all raw traffic as lines: time in s, wire, > for what was sent and < for what came, data; their number."""
    count = 0
    with out.open("w", encoding="utf-8") as file:
        for line in lines(record):
            file.write(f"{line}\n")
            count += 1
    return count


def lines(record: Path) -> Iterator[str]:
    """The lines of `as_text`."""
    for topic, at, told in messages(record, WIRES):
        say = _can if topic == CAN else _other
        yield f"{at // 10**9}.{at % 10**9:09d} {topic} {'>' if told['sent'] else '<'} {say(told)}"


def _can(told: dict[str, Any]) -> str:
    number = f"{told['id']:08X}" if told["extended"] else f"{told['id']:03X}"
    kind = " error" if told["error"] else " remote" if told["remote"] else ""
    return f"{number}{kind} [{told['dlc']}] {_spaced(told['data'])}".rstrip()


def _other(told: dict[str, Any]) -> str:
    if "data" in told:
        data = bytes.fromhex(told["data"])
        shown = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in data)
        return f"{_spaced(told['data'])}  |{shown}|"
    if "text" in told:
        return f"dashboard {told['text']!r}"
    if "request" in told:
        return f"{told['request']} {told['arguments']}"
    return f"state {told['state']}"


def _spaced(data: str) -> str:
    return " ".join(data[k : k + 2] for k in range(0, len(data), 2))


FORMATS: dict[str, tuple[str, Callable[[Path, Path], int]]] = {
    "candump": (".candump.log", as_candump),
    "text": (".wires.txt", as_text),
}
"""By name: how the file's name ends, and what writes it."""
