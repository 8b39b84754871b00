"""Register maps of two drives that have nothing in common, as they stand in `cell.toml`."""

from typing import Any

PATHS: dict[str, Any] = {
    "position": {"address": 0x602C}, "target": {"address": 0x6201}, "speed": {"address": 0x6203, "unit": "rpm"},
    "acceleration": {"address": 0x6204, "unit": "ms to 1000 rpm"},
    "deceleration": {"address": 0x6205, "unit": "ms to 1000 rpm"}, "start": {"address": 0x6002, "value": 0x10},
    "home": {"address": 0x6002, "value": 0x20}, "stop": {"address": 0x6002, "value": 0x40},
    "moving": {"address": 0x1003, "bit": 2}, "homed": {"address": 0x1003, "bit": 6},
    "fault": {"address": 0x1003, "bit": 0}, "alarm": {"address": 0x2203, "words": 1},
    "setup": [{"address": 0x6200, "value": 1}],
}  # fmt: skip
"""A drive with motion paths: one register for all commands, speeds in rpm, ramps as times."""

EDGES: dict[str, Any] = {
    "word_order": "low first", "position": {"address": 0x00CC, "input": True}, "target": {"address": 0x0402},
    "speed": {"address": 0x0480, "words": 2, "unit": "counts/s"},
    "acceleration": {"address": 0x0600, "words": 2, "unit": "counts/s^2"},
    "start": {"address": 0x007D, "value": 0x0008, "then": 0}, "home": {"address": 0x007D, "value": 0x0010, "then": 0},
    "stop": {"address": 0x007D, "value": 0x0020, "then": 0},
    "moving": {"address": 0x007F, "bit": 5, "set": False, "input": True},
    "homed": {"address": 0x007F, "bit": 4, "input": True},
    "fault": {"address": 0x0080, "bit": 7, "set": False, "input": True},
    "left_switch": {"address": 0x0181, "bit": 1, "input": True},
    "right_switch": {"address": 0x0181, "bit": 0, "input": True}, "serial": {"address": 0x0010, "input": True},
}  # fmt: skip
"""A drive whose inputs look for edges: low word first, 32 bits everywhere, states in input registers, some turned."""

RAIL: dict[str, Any] = {
    "driver": "modbus", "url": "/dev/ttyUSB9", "lead": "2 mm", "counts_per_turn": 10_000, "travel": ["0 mm", "100 mm"],
    "max_speed": "40 mm/s", "acceleration": "200 mm/s^2", "serial": "A1234",
}  # fmt: skip
