"""Two wheel drives that are not the simulated ones: `canopen.LocalNode`s with the object dictionary of a servo drive.

SDO server, NMT and heartbeat are the `canopen` package's; the dictionary and the statuswords are as makers' manuals
have them: no halt option, no outputs, no supply voltage, no behaviour on a communication error, so that a drive without
our heartbeat leaves the operational state. They drive at once at what they are told.
"""

from __future__ import annotations

import struct
import threading
import time
from typing import Any

import canopen
from canopen.objectdictionary import (
    INTEGER8,
    INTEGER16,
    INTEGER32,
    UNSIGNED8,
    UNSIGNED16,
    UNSIGNED32,
    VISIBLE_STRING,
    ODArray,
    ODRecord,
    ODVariable,
)
from canopen.sdo import SdoAbortedError

PERIOD_S = 0.005
STATES = {"disabled": 0x0250, "ready": 0x0231, "on": 0x0233, "enabled": 0x0237, "stopping": 0x0217, "fault": 0x0218}
"""Statuswords of a maker's drive: bit 4 voltage and bit 9 remote are set in every state."""


def _variable(index: int, sub: int, kind: int, default: Any, access: str = "rw") -> ODVariable:
    made = ODVariable(f"{index:04X}_{sub}", index, sub)
    made.data_type, made.default, made.access_type = kind, default, access
    return made


def _dictionary(node: int, counts: int) -> canopen.ObjectDictionary:
    found = canopen.ObjectDictionary()
    for index, kind, default, access in (
        (0x1000, UNSIGNED32, 0x00060192, "ro"), (0x1001, UNSIGNED8, 0, "ro"), (0x1017, UNSIGNED16, 0, "rw"),
        (0x1008, VISIBLE_STRING, "SERVO-48", "ro"), (0x100A, VISIBLE_STRING, "FIR-v2213", "ro"),
        (0x6007, INTEGER16, 0, "rw"), (0x603F, UNSIGNED16, 0, "ro"), (0x6040, UNSIGNED16, 0, "rw"),
        (0x6041, UNSIGNED16, 0, "ro"), (0x605A, INTEGER16, 2, "rw"), (0x6060, INTEGER8, 0, "rw"),
        (0x6061, INTEGER8, 0, "ro"), (0x6064, INTEGER32, 0, "ro"), (0x606C, INTEGER32, 0, "ro"),
        (0x6083, UNSIGNED32, 500, "rw"), (0x6084, UNSIGNED32, 500, "rw"), (0x6085, UNSIGNED32, 5000, "rw"),
        (0x60A9, UNSIGNED32, 0x00B44700, "rw"), (0x60FF, INTEGER32, 0, "rw"), (0x6502, UNSIGNED32, 0x3EF, "ro"),
    ):  # fmt: skip
        found.add_object(_variable(index, 0, kind, default, access))
    for index, subs in (
        (0x1016, {0: (UNSIGNED8, 1), 1: (UNSIGNED32, 0)}),
        (0x1018, {0: (UNSIGNED8, 4), 1: (UNSIGNED32, 0x26C), 2: (UNSIGNED32, 9), 3: (UNSIGNED32, 1),
                  4: (UNSIGNED32, 100 + node)}),
        (0x608F, {0: (UNSIGNED8, 2), 1: (UNSIGNED32, 2 * counts), 2: (UNSIGNED32, 2)}),
    ):  # fmt: skip
        record = ODArray(f"{index:04X}", index)
        for sub, (kind, default) in subs.items():
            record.add_member(_variable(index, sub, kind, default))
        found.add_object(record)
    for base, first in ((0x1400, 0x200), (0x1800, 0x180)):
        for k in range(4):
            parameter, mapping = ODRecord(f"P{base + k:X}", base + k), ODRecord(f"M{base + k:X}", base + 0x200 + k)
            cob = 0x40000000 | first + 0x100 * k + node
            for sub, kind, default in ((0, UNSIGNED8, 5), (1, UNSIGNED32, cob), (2, UNSIGNED8, 255)):
                parameter.add_member(_variable(base + k, sub, kind, default))
            for sub in range(9):
                mapping.add_member(_variable(base + 0x200 + k, sub, UNSIGNED32 if sub else UNSIGNED8, 0))
            found.add_object(parameter)
            found.add_object(mapping)
    return found


class OtherDrive:
    """One drive; `deaf` to our heartbeat it drives on for ever."""

    def __init__(self, network: canopen.Network, node: int, counts: int) -> None:
        self.node = network.create_node(node, _dictionary(node, counts))
        self.counts = counts
        self.deaf = False
        self.state, self.word, self.position, self.target = "disabled", 0, 0.0, 0
        self.master = 0.0
        self._network = network
        self.node.add_read_callback(self._read)
        self.node.add_write_callback(self._written)
        network.subscribe(0x200 + node, lambda _i, data, _t: self._command(bytes(data)))
        network.subscribe(0x080, lambda *_: self._notify())
        network.subscribe(0x700 + 127, lambda *_: self._hear())
        self.node.nmt.send_command(0)

    @property
    def speed(self) -> float:
        """Turns of the motor a second."""
        return self.target / 60.0 if self.state == "enabled" else 0.0

    def tick(self, seconds: float) -> None:
        self.position += self.speed * seconds * self.counts
        consumer = int.from_bytes(self.node.data_store.get(0x1016, {}).get(1, b"\0\0\0\0"), "little")
        allowed = 1e-3 * (consumer & 0xFFFF)
        if allowed and self.master and not self.deaf and time.monotonic() - self.master > allowed:
            self.master = 0.0
            self.node.emcy.send(0x8130, 0x11, b"")
            self.state = "fault"
            if self.node.nmt.state == "OPERATIONAL":
                self.node.nmt.state = "PRE-OPERATIONAL"

    def _hear(self) -> None:
        self.master = time.monotonic()

    def _read(self, index: int, subindex: int, od: ODVariable) -> Any:
        word = STATES[self.state]
        mode = int.from_bytes(self.node.data_store.get(0x6060, {}).get(0, b"\0"), "little")
        told = {0x6041: word, 0x6061: mode, 0x6064: round(self.position), 0x606C: round(60.0 * self.speed)}
        return told.get(index)

    def _written(self, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        if index in range(0x1A00, 0x1A04) or index in range(0x1600, 0x1604):
            cob = int.from_bytes(self.node.get_data(index - 0x200, 1), "little")
            if not cob >> 31:
                raise SdoAbortedError(0x08000022)
            if subindex and int.from_bytes(data[2:4], "little") not in self.node.object_dictionary:
                raise SdoAbortedError(0x06040041)
        if index == 0x6040:
            self._control(int.from_bytes(data, "little"))

    def _command(self, data: bytes) -> None:
        if self.node.nmt.state == "OPERATIONAL":
            word, self.target = struct.unpack("<Hi", data)
            self._control(word)

    def _control(self, word: int) -> None:
        rising, self.word = word & ~self.word, word
        if self.state == "fault":
            if rising & 0x80:
                self.state = "disabled"
                self.node.emcy.reset()
        elif word & 0x02 == 0 or word & 0x06 == 0x02:
            self.state = "disabled"
        elif word & 0x0F == 0x0F:
            self.state = {"on": "enabled"}.get(self.state, self.state)
        elif word & 0x0F == 0x07:
            self.state = "on" if self.state in ("ready", "enabled", "on") else self.state
        elif word & 0x07 == 0x06:
            self.state = "ready"

    def _notify(self) -> None:
        if self.node.nmt.state != "OPERATIONAL":
            return
        for k in range(4):
            cob = int.from_bytes(self.node.get_data(0x1800 + k, 1), "little")
            kind = self.node.get_data(0x1800 + k, 2)[0]
            if cob >> 31 or kind != 1:
                continue
            data = b""
            for sub in range(1, self.node.get_data(0x1A00 + k, 0)[0] + 1):
                entry = int.from_bytes(self.node.get_data(0x1A00 + k, sub), "little")
                data += self.node.get_data(entry >> 16, entry >> 8 & 0xFF)
            self._network.send_message(cob & 0x7FF, data)


class OtherDrives:
    """Both, on a bus inside this process; the right one turns backwards when the vehicle drives ahead."""

    def __init__(self, channel: str, counts: int = 10_000) -> None:
        self._network = canopen.Network().connect(interface="virtual", channel=channel)
        self.left, self.right = (OtherDrive(self._network, node, counts) for node in (5, 6))
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ending.wait(PERIOD_S):
            for drive in (self.left, self.right):
                drive.tick(PERIOD_S)

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        for drive in (self.left, self.right):
            drive.node.nmt.stop_heartbeat()
        self._network.disconnect()
