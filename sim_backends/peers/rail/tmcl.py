"""The rail's wire: TMCL requests over TCP (as behind a serial server) or over a pseudo terminal.

Framing as on the serial line: nine bytes make a request, and an incomplete one is forgotten after a pause.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from sim_backends.clock import WorldClock
from sim_backends.models.rail import FAULTS as RAIL_FAULTS
from sim_backends.models.rail import RailModel
from sim_backends.peers.rail.tmcl_module import TmclModule
from sim_backends.peers.serial_port import SerialServer

FAULTS = ("rail.drop_reply", "rail.late_reply", "rail.reset", *RAIL_FAULTS)
LATE_S = 0.2
"""Wall seconds by which `rail.late_reply` delays every reply."""
_REQUEST = 9


class TmclPeer(SerialServer):
    """Serves one module at `url` (`socket://127.0.0.1:port` for pyserial) and, on request, at the device `pty`."""

    def __init__(self, model: RailModel, clock: WorldClock, pty: bool = False) -> None:
        self.module = TmclModule(model, clock)
        self._drop = 0
        self._late = False
        self._lock = threading.Lock()
        super().__init__("rail", self._hear, pty=pty)

    def fault(self, name: str) -> None:
        """Cause a fault of `FAULTS`; ValueError for another name.

        `rail.drop_reply`: the next request is carried out, but its reply is lost. `rail.late_reply`: from now on every
        reply comes `LATE_S` after its request was carried out. `rail.reset`: the module starts anew. The others
        are the rail's own.
        """
        match name:
            case "rail.drop_reply":
                with self._lock:
                    self._drop += 1
            case "rail.late_reply":
                self._late = True
            case "rail.reset":
                self.module.reset()
            case _ if name in RAIL_FAULTS:
                self.module.fault(name)
            case _:
                raise ValueError(f"unknown rail fault {name!r}; known: {', '.join(FAULTS)}")

    def clear(self) -> None:
        """Take away all faults; a module that was reset stays so."""
        with self._lock:
            self._drop = 0
        self._late = False
        self.module.clear()

    def _hear(self, data: bytes, write: Callable[[bytes], object]) -> bytes:
        while len(data) >= _REQUEST:
            reply = self.module.handle(data[:_REQUEST])
            data = data[_REQUEST:]
            if self._late:
                self.stopping.wait(LATE_S)
            if reply is not None and not self._lost():
                write(reply)
        return data

    def _lost(self) -> bool:
        with self._lock:
            if self._drop:
                self._drop -= 1
                return True
            return False
