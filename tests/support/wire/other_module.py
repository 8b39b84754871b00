"""A stepper module that is not the simulated rail: nine-byte telegrams and a six-point ramp, from the vendor's tables.

It shares nothing with `sim_backends`: its ramp is stepped, not solved. `order` says which of 15, 16 and 19 is what: the
vendor's library and the descriptions of its modules differ.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from typing import Literal

STEP_S = 0.0005
Order = Literal["library", "sheet"]
NAMES: dict[Order, dict[str, int]] = {
    "library": {"A1": 15, "V1": 16, "DMAX": 17, "D1": 18, "VSTART": 19, "VSTOP": 20},
    "sheet": {"VSTART": 15, "A1": 16, "DMAX": 17, "D1": 18, "V1": 19, "VSTOP": 20},
}
HOME = -30_000
"""Where the home switch is, in microsteps from where the module was switched on."""


class OtherModule:
    """One module at `url`. Attributes change how it behaves:

    `echo` sends each request back first; `silent` answers nothing; `half`, `bent`, `foreign`, `doubted` are how many of
    the next replies are cut in the middle, come with a wrong sum, follow another module's, or say that the request came
    with a wrong sum; `stubborn` parameters keep their value; `refused` are (parameter, value) that are out of range.
    """

    def __init__(self, order: Order = "library", firmware: str = "1241V144", address: int = 1) -> None:
        self.order: Order = order
        self.firmware = firmware
        self.address = address
        self.echo = self.silent = False
        self.half = self.bent = self.foreign = self.doubted = 0
        self.stubborn: set[int] = set()
        self.refused: set[tuple[int, int]] = set()
        self.power_on()
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        self._ending = False
        self._thread = threading.Thread(target=self._serve, name="other module", daemon=True)
        self._thread.start()

    def power_on(self) -> None:
        """As after a reset: a slow first phase, a deceleration of a quarter, nothing counted, nothing in RAM."""
        self.x = self.v = 0.0
        self.target, self.goal, self.searching = 0, 0.0, False
        self.user = [0] * 256
        self.user[0] = 77
        self.at = time.monotonic()
        slow = {"A1": 20_000, "V1": 30_000, "DMAX": 125_000, "D1": 60_000, "VSTART": 1, "VSTOP": 10}
        self.axis = {4: 51_200, 5: 500_000, 140: 8, 193: 1, 194: 10_000, 195: 1_000, 255: 1}
        self.axis |= {NAMES[self.order][name]: value for name, value in slow.items()}

    def ramp(self, name: str) -> int:
        """What the ramp has under this name."""
        return self.axis[NAMES[self.order][name]]

    def close(self) -> None:
        self._ending = True
        # Closing alone does not wake who waits in accept().
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self._thread.join(5.0)

    # --- motion ---

    def advance(self) -> None:
        now = time.monotonic()
        while self.at + STEP_S <= now:
            self.at += STEP_S
            if self.searching:
                self._seek()
            else:
                self._step()

    def _seek(self) -> None:
        way = HOME - self.x
        far = self.axis[194] * STEP_S
        self.x += max(-far, min(far, way))
        if self.x == HOME:
            self.x, self.target, self.v, self.searching = 0.0, 0, 0.0, False

    def _step(self) -> None:
        way = self.target - self.x
        side = 1.0 if way >= 0 else -1.0
        speed, bend = self.v * side, self.ramp("V1")
        if speed <= 0.0 and abs(way) < 1.0:
            self.x, self.v = float(self.target), 0.0
            return
        low = min(speed, bend)
        stop = low * low / (2.0 * max(1, self.ramp("D1"))) + max(0.0, speed**2 - bend**2) / (2.0 * self.ramp("DMAX"))
        if abs(way) <= stop:
            slope = self.ramp("DMAX") if speed > bend else max(1, self.ramp("D1"))
            speed = max(speed - slope * STEP_S, min(200.0, abs(way) / STEP_S))
        else:
            slope = self.axis[5] if speed >= bend else self.ramp("A1")
            speed = min(speed + slope * STEP_S, self.axis[4])
        moved = min(abs(way), speed * STEP_S)
        self.x += side * moved
        self.v = 0.0 if moved == abs(way) else side * speed

    # --- telegrams ---

    def _serve(self) -> None:
        while not self._ending:
            try:
                connection, _ = self._server.accept()
            except OSError:
                return
            with connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                while data := self._read(connection):
                    if self.echo:
                        connection.sendall(data)
                    if (reply := self._answer(data)) is not None and not self.silent:
                        connection.sendall(self._spoilt(reply))

    @staticmethod
    def _read(connection: socket.socket) -> bytes:
        data = b""
        while len(data) < 9:
            try:
                more = connection.recv(9 - len(data))
            except OSError:
                return b""
            if not more:
                return b""
            data += more
        return data

    def _spoilt(self, reply: bytes) -> bytes:
        if self.half:
            self.half -= 1
            return reply[:5]
        if self.bent:
            self.bent -= 1
            return reply[:4] + bytes([reply[4] ^ 0x10]) + reply[5:]
        if self.foreign:
            self.foreign -= 1
            return _signed(struct.pack(">BBBBi", 2, 9, 100, 6, 5)) + reply
        return reply

    def _answer(self, data: bytes) -> bytes | None:
        address, command, kind, _, value, total = struct.unpack(">BBBBiB", data)
        if address != self.address:
            return None
        if self.doubted or sum(data[:8]) % 256 != total:
            self.doubted = max(0, self.doubted - 1)
            return self._reply(1, command, 0)
        self.advance()
        if command == 136:
            return b"\x02" + self.firmware.encode().ljust(8)
        status, value = self._run(command, kind, value)
        return self._reply(status, command, value)

    def _reply(self, status: int, command: int, value: int) -> bytes:
        return _signed(struct.pack(">BBBBi", 2, self.address, status, command, value))

    def _run(self, command: int, kind: int, value: int) -> tuple[int, int]:
        match command:
            case 3:
                self.target, self.v, self.searching = round(self.x), 0.0, False
            case 4:
                self.target = value
            case 5 if (kind, value) in self.refused:
                return 4, 0
            case 5 if kind in self.axis:
                if kind not in self.stubborn:
                    self.axis[kind] = value
            case 6:
                return self._get(kind)
            case 9:
                self.user[kind] = value
            case 10:
                return 100, self.user[kind]
            case 13 if kind == 2:
                return 100, int(self.searching)
            case 13:
                self.searching = kind == 0
            case _:
                return 3, 0
        return 100, value

    def _get(self, kind: int) -> tuple[int, int]:
        shown = {
            0: self.target, 1: round(self.x), 3: round(self.v), 8: int(self.x == self.target), 10: 0, 11: 0, 207: 0,
            208: 0, **self.axis,
        }  # fmt: skip
        return (100, shown[kind]) if kind in shown else (3, 0)


def _signed(body: bytes) -> bytes:
    return body + bytes([sum(body) % 256])
