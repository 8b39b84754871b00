"""A line to a simulated world that follows real devices: one request at a time, answered at once."""

from __future__ import annotations

import json
import socket
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from drivers.errors import DeviceFault
from drivers.interfaces import Identity

TIMEOUT_S = 5.0


class WorldLink:
    """A connection to the endpoint at `address`; safe between threads."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._asking = threading.Lock()
        host, port = address.rsplit(":", 1)
        try:
            self._socket = socket.create_connection((host, int(port)), timeout=TIMEOUT_S)
        except OSError as error:
            raise self._lost(error) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._file = self._socket.makefile("rwb")

    def ask(self, **request: Any) -> dict[str, Any]:
        """The answer to a request; `DeviceFault` (sim.lost) when none comes, or when it was refused."""
        with self._asking:
            try:
                self._file.write(json.dumps(request).encode() + b"\n")
                self._file.flush()
                answer: dict[str, Any] = json.loads(self._file.readline())
            except (OSError, ValueError) as error:
                # An answer that comes after all would be taken for the next request's.
                self.close()
                raise self._lost(error) from error
        if not answer.get("ok"):
            raise self._lost(answer.get("error"))
        return answer

    def close(self) -> None:
        """End the connection; idempotent."""
        with suppress(OSError):
            self._file.close()
        self._socket.close()

    def _lost(self, why: object) -> DeviceFault:
        return DeviceFault(
            "simulated world",
            "sim.lost",
            f"it does not take what the real devices do: {why}",
            recoverable=False,
            hint="Its process has ended or hangs; open the cell again.",
        )


@dataclass(frozen=True)
class _Outputs:
    """What a connector shows; see `drivers.switches.Shown`."""

    digital_outputs: int


class WorldConnector:
    """Where a simulated laser or claw hangs while the arm is real; see `drivers.switches.Connector`."""

    def __init__(self, link: WorldLink) -> None:
        self._link = link

    def identity(self) -> Identity:
        """That it is simulated."""
        return Identity("simulated world", "", "", self._link.address)

    def ping(self) -> float:
        """One round trip, wall seconds."""
        begun = time.monotonic()
        self._link.ask(op="time")
        return time.monotonic() - begun

    def state(self) -> _Outputs:
        """The outputs as they are in the simulated world."""
        return _Outputs(int(self._link.ask(op="connector")["outputs"]))

    def set_digital_output(self, index: int, value: bool) -> None:
        """Set an output of the simulated world."""
        self._link.ask(op="switch", output=index, on=value)

    def digital_input(self, index: int) -> bool:
        """Read an input of the simulated world."""
        return bool(int(self._link.ask(op="connector")["inputs"]) >> index & 1)
