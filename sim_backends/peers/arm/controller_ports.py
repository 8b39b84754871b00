"""Several listening TCP ports on one loopback address, polled without blocking by the thread that owns them.

A client that vanishes, floods or stops reading never stops the others.

What the real-time port tells its clients 500 times a second: a packet of 1220 bytes, as controllers from 5.10 on do.

All numbers but the size are f64, big-endian. Source: the maker's table of the real-time client interface."""

from __future__ import annotations

import os
import select
import socket
import struct
from collections.abc import Iterator, Sequence

from sim_backends.models.arm import Power
from sim_backends.peers.arm.rtde.variables import RegisterView

_BACKLOG_LIMIT = 1 << 20
_CHUNK = 1 << 16


class Client:
    """One accepted connection; `send` never blocks, and a client that stops reading is dropped."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection
        self._backlog = bytearray()
        self.open = True

    def fileno(self) -> int:
        """The socket's descriptor."""
        return self._socket.fileno()

    def send(self, data: bytes) -> None:
        """Send `data`, keeping back what the client cannot take yet."""
        if not self.open:
            return
        if self._backlog:
            self._backlog += data
            data = bytes(self._backlog)
        try:
            sent = self._socket.send(data)
        except BlockingIOError:
            sent = 0
        except OSError:
            self.close()
            return
        if sent < len(data) or self._backlog:
            self._backlog = bytearray(data[sent:])
            if len(self._backlog) > _BACKLOG_LIMIT:
                self.close()

    def offer(self, data: bytes) -> None:
        """Send `data` whole, or not at all while the client has not taken what was sent before."""
        if self._backlog:
            self.send(b"")
        if not self._backlog:
            self.send(data)

    def receive(self) -> bytes | None:
        """What has arrived, empty if nothing; None once the connection has ended."""
        if not self.open:
            return None
        try:
            data = self._socket.recv(_CHUNK)
            # Without this some clients' small writes wait 40 ms for the delayed acknowledgement.
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self.close()
            return None
        return data

    def close(self) -> None:
        """Mark as ended; the descriptor is released by the owner of the ports."""
        self.open = False

    def release(self) -> None:
        """Close the socket."""
        self.open = False
        self._socket.close()


class TcpPorts:
    """Listening sockets on `ports` of one address in 127.0.0.0/8."""

    def __init__(self, ports: Sequence[int], host: str | None = None) -> None:
        """Bind on `host`, or on the first of 127.0.n.2 … 127.0.n.254 where all ports are free; OSError if none is.

        n follows from the process: a client of an arm that has died must not find another one at its address.
        """
        net = os.getpid() % 250
        hosts = [host] if host is not None else [f"127.0.{net}.{i}" for i in range(2, 255)]
        self._listeners: dict[int, tuple[int, socket.socket]] = {}
        error: OSError | None = None
        for candidate in hosts:
            try:
                listeners = _listen(candidate, ports)
            except OSError as failure:
                error = failure
                continue
            self.host = candidate
            self._listeners = {s.fileno(): (port, s) for port, s in zip(ports, listeners, strict=True)}
            break
        else:
            tried = f"{hosts[0]} … {hosts[-1]}" if len(hosts) > 1 else hosts[0]
            raise OSError(f"ports {tuple(ports)} are not free on {tried}: stop the other simulator ({error})")
        self._clients: dict[int, tuple[int, Client]] = {}
        self._poll = select.poll()
        for descriptor in self._listeners:
            self._poll.register(descriptor, select.POLLIN)

    def poll(self) -> Iterator[tuple[int, Client, bytes | None]]:
        """What happened since the last call as (port, client, data): b"" for a new client, None for one that left."""
        for descriptor, _ in self._poll.poll(0):
            if descriptor in self._listeners:
                port, listener = self._listeners[descriptor]
                try:
                    client = Client(listener.accept()[0])
                except OSError:
                    continue
                self._clients[client.fileno()] = (port, client)
                self._poll.register(client.fileno(), select.POLLIN)
                yield port, client, b""
            elif descriptor in self._clients:
                port, client = self._clients[descriptor]
                data = client.receive()
                if data:
                    yield port, client, data
        for descriptor, (port, client) in list(self._clients.items()):
            if not client.open:
                self._poll.unregister(descriptor)
                del self._clients[descriptor]
                client.release()
                yield port, client, None

    def close(self) -> None:
        """Close everything; idempotent."""
        for _, client in self._clients.values():
            client.release()
        for _, listener in self._listeners.values():
            listener.close()
        self._clients.clear()
        self._listeners.clear()


def _listen(host: str, ports: Sequence[int]) -> list[socket.socket]:
    listeners: list[socket.socket] = []
    try:
        for port in ports:
            listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            listeners.append(listener)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            listener.listen(8)
            listener.setblocking(False)
    except OSError:
        for listener in listeners:
            listener.close()
        raise
    return listeners


_PACKET = struct.Struct(">i152d")
_SIX, _THREE = (0.0,) * 6, (0.0,) * 3


def real_time_packet(view: RegisterView) -> bytes:
    """The packet for this cycle."""
    model, drive = view.model, view.model.drive
    q, qd = drive.q.tolist(), drive.qd.tolist()
    pose, speed = view.tcp_pose(), view.tcp_speed()
    mass, centre = model.payload
    mode = 253.0 if model.power is Power.RUNNING else 239.0
    on = 48.0 if model.power is not Power.OFF else 0.0
    fraction = drive.speed_fraction
    return _PACKET.pack(
        _PACKET.size, model.time,
        *q, *qd, *_SIX, *_SIX, *_SIX,  # target positions, speeds, accelerations, currents, moments
        *q, *qd, *_SIX, *_SIX,  # actual positions, speeds, currents; control currents
        *pose, *speed, *model.felt.tolist(), *pose, *speed,  # actual tool pose, speed, force; target pose, speed
        float(model.digital_inputs), *[30.0] * 6, 0.0, 0.0,  # inputs, motor temperatures, two times of the controller
        float(model.power), *[mode] * 6, float(model.safety_mode),
        *_SIX, *_THREE, *_SIX,  # unused, tool accelerometer, unused
        fraction, 0.0, fraction, 0.0, 48.0, on, 0.5, *[on] * 6,  # scaling, momentum, two unused, supplies
        float(model.digital_outputs), float(view.runtime_state),
        *_THREE, *_THREE, float(model.safety_mode), *_THREE,  # elbow place, speed; safety status; unused
        mass, *centre.tolist(), *_SIX,
    )  # fmt: skip
