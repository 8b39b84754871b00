"""Child side: the arm's digital outputs: switched, kept low while no program runs, and all off in an arm at rest.

Child side: the state packets of the arm, one every 2 ms, as `Snapshot`s."""

import os
import signal
import socket
import struct
import time

from drivers.arm.child.program import PERIOD
from drivers.arm.feed import STOPPED, Snapshot
from drivers.arm.link import RATE_HZ, STATE, VARIABLES, VERSION, RtdeLink
from drivers.clock import Clock

KINDS = ("standard", "configurable", "tool")
"""Of digital outputs, eight of each but the last."""


class Packets:
    """What the arm at `address` sends of itself; OSError when it does not answer, or not any more. Over a connection of
    its own that is waited for: ur-rtde's looks 10 000 times a second whether something has come."""

    def __init__(self, address: str, switches: bool) -> None:
        """OSError when it `switches` the digital outputs and another client does."""
        self._link = RtdeLink(address, Clock(), SILENCE_S)
        self._link.ask("V", struct.pack(">H", VERSION))
        self._link.ask("O", struct.pack(">d", RATE_HZ) + ",".join(VARIABLES).encode())
        if switches:
            names = (f"{kind}_digital_output{part}" for kind in KINDS for part in ("_mask", ""))
            (self._recipe,) = self._link.ask("I", ",".join(names).encode())[:1]
            if not self._recipe:
                raise OSError("its digital outputs are already in use by another program")
        self._link.ask("S", b"")

    def switch(self, index: int, value: bool) -> None:
        """Set digital output `index`: 0-7 standard, 8-15 configurable, 16-17 tool."""
        fields = bytearray(2 * len(KINDS))
        kind, number = divmod(index, 8)
        fields[2 * kind : 2 * kind + 2] = 1 << number, value << number
        self._link.send("U", bytes([self._recipe, *fields]))

    def wait(self, seconds: float) -> bool:
        """Whether a packet has come since the one that was read last, or comes within so long on the wall: whole."""
        return self._link.wait(seconds)

    def read(self) -> Snapshot:
        """The newest packet, where none has come the next one."""
        state = self._link.newest("U", SILENCE_S)
        if len(state) != STATE.size:
            raise OSError(f"a state of {len(state)} bytes came, {STATE.size} were agreed")
        _, stamp, *joints, inputs, outputs, mode, _, safety_bits, runtime, mass, x, y, z = STATE.unpack(state)
        q, qd, flange, wrench = (tuple(joints[k : k + 6]) for k in range(0, 24, 6))
        return Snapshot(
            time.monotonic(), q, qd, flange, wrench, safety_bits=safety_bits, mode=mode, runtime=runtime, inputs=inputs,
            outputs=outputs, device_time=stamp, payload=(mass, (x, y, z)),
        )  # fmt: skip


SILENCE_S = 1.5
"""The arm counts as lost after this time without a packet; it sends one every 2 ms."""
OFF_S = 1.0
"""How long on the wall an output may take to be seen off."""
_SAFE_S = 5.0
_SECONDARY_PORT = 30002
_GREETING = 79
"""Bytes that the maker wants read from that port before it is closed; else what was sent may be discarded."""
_STAYS, _LOW_WHEN_NOT_RUNNING = 0, 1
_NOT_SAFE = 4
"""Exit code of `--safe` when an output stays on or the arm does not come to rest."""


def keep_low(address: str, outputs: tuple[int, ...], free: tuple[int, ...] = ()) -> None:
    """Have the controller keep outputs low whenever no program runs, whatever becomes of the link; `free` stay as set.
    A secondary program runs beside the main one and leaves it alone. Source: the maker's script manual."""
    choices = [(index, _LOW_WHEN_NOT_RUNNING) for index in outputs] + [(index, _STAYS) for index in free]
    if not choices:
        return
    lines = []
    for index, choice in choices:
        lines.append(f"  set_runstate_{KINDS[index // 8]}_digital_output_to_value({index % 8}, {choice})\n")
    try:
        _say(address, f"sec cell_outputs():\n{''.join(lines)}end\n".encode())
    except OSError as error:
        why = f"is silent for {OFF_S:g} s" if isinstance(error, TimeoutError) else f"fails: {error}"
        raise RuntimeError(
            f"port {_SECONDARY_PORT} of the arm {why}, so the outputs that stay low were not set. Open that port "
            "between this computer and the controller (Settings, Security, Services: secondary client interface)"
        ) from error


def _say(address: str, program: bytes) -> None:
    with socket.create_connection((address, _SECONDARY_PORT), timeout=OFF_S) as connection:
        connection.sendall(program)
        read = 0
        while read < _GREETING:
            data = connection.recv(4096)
            if not data:
                raise ConnectionResetError("it was closed before it took the setting")
            read += len(data)


def make_safe(address: str, outputs: list[int]) -> None:
    """Switch outputs off, then see on the arm's own word that they are and that it stands."""
    signal.setitimer(signal.ITIMER_REAL, _SAFE_S)
    packets = Packets(address, switches=bool(outputs))
    for index in outputs:
        packets.switch(index, False)
    mask = sum(1 << index for index in outputs)
    clock, deadline = Clock(), time.monotonic() + OFF_S

    def unsafe() -> bool:
        snapshot = packets.read()
        # A program that is only paused would go on when it is released.
        return bool(snapshot.outputs & mask) or not snapshot.at_rest or snapshot.runtime > STOPPED

    while unsafe():
        if time.monotonic() > deadline:
            os._exit(_NOT_SAFE)
        clock.sleep(PERIOD)
    os._exit(0)
