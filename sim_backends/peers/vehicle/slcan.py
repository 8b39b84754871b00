"""A CAN bus behind slcan adapters on TCP, and a vehicle on it (docs/reference/protocols.md, section 4).

Every client is an adapter on the same bus. What one client sends reaches the owner of the bus and all other clients; an
adapter that is not open, is set to another bit rate or listens only takes no part in sending.
"""

import contextlib
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from sim_backends.clock import WorldClock
from sim_backends.faults import VEHICLE_MODEL_FAULTS
from sim_backends.models.vehicle import VehicleModel
from sim_backends.peers.server import TcpServer

_OK, _ERROR = b"\r", b"\a"
_BIT_RATES = "012345678"
_BUS_RATE = "6"
"""S6 is 500 kbit/s, the rate of this bus and of an adapter that was not told another."""
_FIFO = 64 * 1024
_FLAG_FIFO_FULL, _FLAG_WARNING, _FLAG_BUS_ERROR = 0x01, 0x04, 0x80


@dataclass(frozen=True)
class CanFrame:
    """One data frame, or a remote request for `length` bytes."""

    id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    length: int = 0


class SlcanBus(TcpServer):
    """The bus. `receive` is called with each frame that a client sends, in that client's thread."""

    def __init__(self, name: str, receive: Callable[[CanFrame], None]) -> None:
        super().__init__(name, self._serve)
        self.refusing = False
        """Whether every frame is refused, as by adapters that are bus-off."""
        self._receive = receive
        self._adapters_lock = threading.Lock()
        self._adapters: list[_Adapter] = []
        self.channel = f"socket://{self.address}"

    def send(self, frames: list[CanFrame], sender: "_Adapter | None" = None) -> None:
        """Put frames on the bus: all adapters but `sender` get them."""
        lines = b"".join(_encode(frame) for frame in frames)
        with self._adapters_lock:
            adapters = list(self._adapters)
        for adapter in adapters:
            if adapter is not sender:
                adapter.deliver(lines)

    def _serve(self, connection: socket.socket) -> None:
        adapter = _Adapter(connection)
        with self._adapters_lock:
            self._adapters.append(adapter)
        try:
            pending = b""
            while data := connection.recv(4096):
                *lines, pending = (pending + data).split(b"\r")
                for line in lines:
                    self._command(adapter, line)
                if len(pending) > 256:
                    pending = b""
        finally:
            with self._adapters_lock:
                self._adapters.remove(adapter)

    def _command(self, adapter: "_Adapter", line: bytes) -> None:
        text = line.decode("ascii", "replace").strip("\n\0")
        kind, rest = text[:1], text[1:]
        if kind in ("t", "T", "r", "R"):
            frame = _decode(text)
            if frame is None or not adapter.open or adapter.listening or self.refusing:
                adapter.put(_ERROR)
            elif adapter.rate != _BUS_RATE:
                adapter.bus_error = True
                adapter.put(_ERROR)
            else:
                adapter.put(b"z\r" if kind in "tr" else b"Z\r")
                self.send([frame], sender=adapter)
                self._receive(frame)
        elif kind == "V":
            adapter.put(b"V1013\r")
        elif kind == "N":
            adapter.put(b"NSIM1\r")
        elif kind == "F":
            adapter.put(f"F{adapter.flags():02X}\r".encode("ascii"))
        else:
            adapter.put(_OK if adapter.configure(kind, rest) else _ERROR)


class _Adapter:
    """One client: its channel's state, and what is still to be sent to it."""

    def __init__(self, connection: socket.socket) -> None:
        self.rate = _BUS_RATE
        self.open = False
        self.listening = False
        self.bus_error = False
        self._overrun = False
        self._connection = connection
        self._lock = threading.Lock()
        self._outgoing = bytearray()

    def configure(self, kind: str, rest: str) -> bool:
        """Carry out a command that changes the channel; False when it is not possible."""
        if kind in ("O", "L") and not rest and not self.open:
            self.open, self.listening, self.bus_error = True, kind == "L", False
        elif kind == "C" and not rest:
            self.open = False
        elif kind == "S" and len(rest) == 1 and rest in _BIT_RATES and not self.open:
            self.rate = rest
        else:
            return kind == "" or (kind == "Z" and rest == "0")
        return True

    def flags(self) -> int:
        """Status flags since they were read last."""
        flags = _FLAG_FIFO_FULL * self._overrun | (_FLAG_BUS_ERROR | _FLAG_WARNING) * self.bus_error
        self._overrun = self.bus_error = False
        return flags

    def deliver(self, lines: bytes) -> None:
        """Frames from the bus; lost when the channel is closed, wrongly set or its host does not read."""
        if self.open and self.rate == _BUS_RATE:
            self.put(lines)

    def put(self, data: bytes) -> None:
        """Send to the host what it takes now, and keep the rest."""
        with self._lock:
            if len(self._outgoing) + len(data) > _FIFO:
                self._overrun = True
            else:
                self._outgoing += data
            with contextlib.suppress(OSError):
                while self._outgoing:
                    sent = self._connection.send(self._outgoing, socket.MSG_DONTWAIT)
                    del self._outgoing[:sent]


def _encode(frame: CanFrame) -> bytes:
    kind = "r" if frame.remote else "t"
    head = f"{kind.upper()}{frame.id:08X}" if frame.extended else f"{kind}{frame.id:03X}"
    length = frame.length if frame.remote else len(frame.data)
    return f"{head}{length}{frame.data.hex().upper()}\r".encode("ascii")


def _decode(text: str) -> CanFrame | None:
    extended, remote = text[0] in "TR", text[0] in "rR"
    digits = 8 if extended else 3
    identifier, length, data = text[1 : 1 + digits], text[1 + digits : 2 + digits], text[2 + digits :]
    try:
        number, count, payload = int(identifier, 16), int(length, 10), bytes.fromhex(data)
    except ValueError:
        return None
    if len(identifier) < digits or count > 8 or number >= (1 << (29 if extended else 11)):
        return None
    if len(payload) != (0 if remote else count):
        return None
    return CanFrame(number, payload, extended, remote, count)


_TICK = 0.005


class CanPeer(ABC):
    """A vehicle on the bus: serves it as slcan adapters at `channel` and lets the vehicle's time pass. Open it with
    python-can: `Bus(interface=peer.interface, channel=peer.channel, sleep_after_open=0)`."""

    interface = "slcan"
    FAULTS: tuple[str, ...]

    def __init__(self, model: VehicleModel, clock: WorldClock) -> None:
        self.model = model
        self._clock = clock
        self._bus = SlcanBus("vehicle", self._receive)
        self.channel = self._bus.channel
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vehicle", daemon=True)

    @property
    def endpoint(self) -> dict[str, str]:
        """Where python-can finds it."""
        return {"interface": self.interface, "channel": self.channel}

    def start(self) -> None:
        """Begin to serve."""
        self._bus.start()
        self._thread.start()

    def stop(self) -> None:
        """End all connections and threads; idempotent."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._bus.stop()

    def fault(self, name: str) -> None:
        """`can.bus_off`: the adapters drop out and have to be opened again; or one of the vehicle's own. Raises
        ValueError for a name that is not in `FAULTS`."""
        if name == "can.bus_off":
            self._bus.drop()
        elif name in VEHICLE_MODEL_FAULTS:
            self.model.fault(name, self._clock.now())
        else:
            raise ValueError(f"unknown vehicle fault {name!r}; known: {', '.join(self.FAULTS)}")

    def clear(self) -> None:
        """Take away the causes of faults."""
        self.model.clear(self._clock.now())

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stopping.wait(max(0.0, due - time.monotonic())):
            due = max(due + _TICK, time.monotonic())
            self._tick(self._clock.now())

    @abstractmethod
    def _receive(self, frame: CanFrame) -> None:
        """A frame from somebody else on the bus, in that client's thread."""

    @abstractmethod
    def _tick(self, t: float) -> None:
        """Let time pass up to `t` s of the world, every 5 ms of the wall."""
