"""A vehicle that is not the simulated one: AgileX protocol v2 from the maker's SDK, on a CAN bus inside this process.

Frames are packed here by hand. It shares nothing with `sim_backends`, and drives at once at what it is told.
"""

from __future__ import annotations

import itertools
import struct
import threading
import time
from typing import Literal

import can

CHANNELS = (f"other vehicle {count}" for count in itertools.count())
WAVER = (3, -3, 1, -2, 3, 0, -3, 2)
"""What a vehicle at rest reports as its speed, mm/s and mrad/s, one after the other."""


class OtherVehicle:
    """Attributes change how it behaves: `lost` identifiers are not sent, `short` ones with a byte less; `mode`, `state`
    and `errors` are what 0x211 reports; `noisy` wavers at rest; `versions` is how it answers for its version. With
    `crowded` other nodes are on the bus: long identifiers of its own numbers that say it is fast, hot and in emergency
    stop, remote requests, error frames, numbers that nobody knows; and the count in 0x211 jumps."""

    interface = "virtual"

    def __init__(self, versions: Literal["sdk", "manual", "none"] = "sdk") -> None:
        self.versions = versions
        self.channel = next(CHANNELS)
        self.lost: set[int] = set()
        self.short: set[int] = set()
        self.mode, self.state, self.errors, self.noisy = 0, 0, 0, True
        self.under_remote_control = self.crowded = False
        self.speed = self.yaw_rate = 0.0
        self.left = self.right = 0.0
        self.braked: bool | None = None
        self.told = 0.0
        self._bus = can.Bus(interface=self.interface, channel=self.channel)
        self._ending = threading.Event()
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._listen, self._talk)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        self._ending.set()
        for thread in self._threads:
            thread.join()
        self._bus.shutdown()

    def _send(self, identifier: int, data: bytes) -> None:
        if identifier not in self.lost:
            data = data[:-1] if identifier in self.short else data
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def _crowd(self) -> None:
        wild = {0x211: bytes([1, 3, 0, 1, 255, 255, 0, 9]), 0x221: b"\x7f\xff" * 4, 0x311: b"\x7f\xff\xff\xff" * 2}
        wild |= {0x251: b"\x7f\xff" * 4, 0x261: b"\x7f" * 8, 0x361: b"\x7f" * 8, 0x111: b"\x01\xf4" * 4, 0x131: b"\x00"}
        for identifier, data in wild.items():
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=True))
            self._bus.send(can.Message(arbitration_id=identifier, dlc=8, is_remote_frame=True, is_extended_id=False))
        self._bus.send(can.Message(arbitration_id=0x20000004, dlc=8, data=b"\x00\x04" * 4, is_error_frame=True))
        self._bus.send(can.Message(arbitration_id=0x7FF, data=b"", is_extended_id=False))
        self._bus.send(can.Message(arbitration_id=0x1FFFFFFF, data=b"\xff" * 8, is_extended_id=True))

    def _listen(self) -> None:
        while not self._ending.is_set():
            frame = self._bus.recv(0.05)
            if frame is None or not frame.data:
                continue
            first = frame.data[0]
            match frame.arbitration_id:
                case 0x421 if not self.under_remote_control:
                    self.mode = first
                case 0x111 if self.mode == 1:
                    speed, yaw_rate, *_ = struct.unpack(">4h", frame.data)
                    self.speed, self.yaw_rate, self.told = speed / 1000, yaw_rate / 1000, time.monotonic()
                case 0x131:
                    self.braked = first == 1
                case 0x441:
                    self.errors &= 0x0006
                case 0x4A1 if self.versions == "sdk" and bytes(frame.data) == b"\x01":
                    text = b"HW V1.2 SW V3.4 20240105".ljust(80)
                    for k in range(0, 80, 8):
                        self._send(0x4A1, text[k : k + 8])
                case 0x411 if self.versions == "manual" and first == 1:
                    self._send(0x41A, bytes([0, 2, 0, 1, 1, 4, 0, 9]))

    def _talk(self) -> None:
        waver = itertools.cycle(WAVER)
        for count in itertools.count():
            if self._ending.wait(0.02):
                return
            if time.monotonic() - self.told > 0.5 or self.mode != 1 or self.state or self.braked:
                self.speed = self.yaw_rate = 0.0
            self.left += 20 * (self.speed - 0.29 * self.yaw_rate)
            self.right += 20 * (self.speed + 0.29 * self.yaw_rate)
            noise = next(waver) if self.noisy else 0
            shown = (round(1000 * self.speed) + noise, round(1000 * self.yaw_rate) - noise, 0, 0)
            self._send(0x221, struct.pack(">4h", *shown))
            self._send(0x311, struct.pack(">2i", round(self.left), round(self.right)))
            if self.crowded:
                self._crowd()
            if count % 5 == 0:
                jumped = count * 37 if self.crowded else count
                system = struct.pack(">BBHHBB", self.state, self.mode, 245, self.errors, 0, jumped % 256)
                self._send(0x211, system)
            if count % 25 == 0:
                self._send(0x361, struct.pack(">BBhhh", 12, 98, 245, -15, 253))
