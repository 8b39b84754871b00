"""The controller's TCP ports on one loopback address, and what the script ports tell their clients.

Primary (30001) and secondary (30002) tell the version once and the state ten times a second, the primary one messages
as well, real time (30003) a packet of 1220 bytes in every cycle, as controllers from 5.10 on do. What is sent there is
run; 30011 to 30013 tell the same and take nothing. Numbers are big-endian: a package is i32 size, u8 type and its
content, a part of it u32 size, u8 type and its content.

Sources: the maker's client interface guide and `Universal_Robots_Client_Library`, `src/primary`. Parts and their order
are those of a recorded controller; the internal ones (9, 10) are empty, currents and temperatures usual values.
"""

import os
import select
import socket
import struct
import zlib
from collections.abc import Iterator, Sequence

import numpy as np

from sim_backends.models.arm import ArmModel, Power, Safety
from sim_backends.models.arm_kinematics import TABLES, Matrix, pose_from_matrix
from sim_backends.peers.arm.dashboard import VERSION
from sim_backends.peers.arm.program import Announcement, ProgramMemory
from sim_backends.peers.arm.rtde.variables import RegisterView
from sim_backends.peers.arm.urscript.translate import ScriptCollector

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
        """Bind on `host`, or on the first of 127.0.n.2 … 127.0.n.254 where all ports are free; OSError if none is. n
        follows from the process: a client of an arm that has died must not find another one at its address."""
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


_REAL_TIME_PACKET = struct.Struct(">i152d")
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
    return _REAL_TIME_PACKET.pack(
        _REAL_TIME_PACKET.size, model.time,
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


_STATE, _MESSAGE = 16, 20
_LINEARISED = 2
"""The status of an arm that was calibrated in the factory."""
_PROJECT, _BUILT = b"URControl", b"10-11-2023, 00:00:00"
_MODELS = {
    **dict.fromkeys(("UR5", "UR5e", "UR7e"), 1), **dict.fromkeys(("UR10", "UR10e", "UR12e"), 2),
    **dict.fromkeys(("UR3", "UR3e"), 3), "UR16e": 4, "UR20": 7, "UR30": 8,
}  # fmt: skip
"""The controller's numbers of the models; the newer names of a model have its number."""
_USUAL = (0.0, 48.0, 30.0, 30.0)
"""Current, A, voltage, V, and the temperatures, °C, of a joint."""
_RUNNING, _OFF = 253, 239
"""What joints and tool say of themselves."""
_TEXT, _POPUP, _VERSION, _SAFETY, _ERROR, _KEY, _EXCEPTION = 0, 2, 3, 5, 6, 7, 10
_WARNING, _VIOLATION = 2, 3
"""Report levels: a protective stop, and an error that ends what its sender wanted."""
_STOPPED, _READ_ONLY = 209, 210
"""Error codes: a protective stop was triggered; a script came while the arm was not in remote control."""


def version_message(version: tuple[int, int, int, int]) -> bytes:
    """The package that greets a client; `version` is major, minor, bug fix, build."""
    return _message(_VERSION, struct.pack(">b", len(_PROJECT)) + _PROJECT + struct.pack(">BBii", *version) + _BUILT)


def message(kind: str, words: str, time: float, line: int = 0, column: int = 0) -> bytes:
    """A message of the primary port: text, popup, started or stopped (a program by its name), failed, warning or
    read-only; what failed has a place in its script."""
    text = words.encode(errors="replace")
    if kind == "text":
        return _message(_TEXT, text, time)
    if kind == "popup":
        title = b"Popup"
        warning = error = blocking = False
        flags = bytes((warning, error, blocking))
        return _message(_POPUP, struct.pack(">IB", 0, 0) + flags + bytes((len(title),)) + title + text, time)
    if kind == "failed":
        return _message(_EXCEPTION, struct.pack(">ii", line, column) + text, time)
    if kind in ("read-only", "warning"):
        code, level = (_READ_ONLY, _VIOLATION) if kind == "read-only" else (_STOPPED, _WARNING)
        return _message(_ERROR, struct.pack(">iii", code, 0, level) + struct.pack(">II", 0, 0) + text, time)
    title = f"PROGRAM_XXX_{kind.upper()}".encode()
    return _message(_KEY, struct.pack(">iiB", 0, 0, len(title)) + title + text, time)


def safety_message(mode: int, time: float) -> bytes:
    """The message that the safety system has changed to `mode`."""
    return _message(_SAFETY, struct.pack(">iiB", 0, 0, mode) + struct.pack(">II", 0, 0), time)


def robot_state(model: ArmModel, runtime_state: int, analog_out: list[float]) -> bytes:
    """The state package with all its parts; `runtime_state` is that of RTDE."""
    others = (
        _joints(model), _cartesian(model), _kinematics(model.params.dh), _part(9, bytes(48)),
        _masterboard(model, analog_out),
        _part(2, bytes(18) + struct.pack(">fBff", 48.0, 0, 0.0, 30.0) + bytes((_mode(model),))), _configuration(model),
        _part(7, struct.pack(">7d", *model.felt, 0.0)), _part(8, bytes(4)), _part(10, bytes(38)),
        _part(11, bytes((False,)) + struct.pack(">iii", 115200, 0, 1) + struct.pack(">ff", 1.5, 3.5)),
        _part(12, bytes(3)),
    )  # fmt: skip
    return robot_mode(model, runtime_state, *others)


def robot_mode(model: ArmModel, runtime_state: int, *others: bytes) -> bytes:
    """The state package with the robot's mode as its first part, and `others` behind it."""
    on = model.power is not Power.OFF
    stopped = model.safety is Safety.EMERGENCY_STOP, model.safety is Safety.PROTECTIVE_STOP
    running, paused = runtime_state == 2, runtime_state in (3, 4)
    flags = (True, True, on, *stopped, running, paused)
    speed = model.drive.speed_fraction
    content = struct.pack(">Q7?BBdddB", round(1e6 * model.time), *flags, int(model.power), 0, speed, speed, 1.0, 0)
    return _package(_STATE, b"".join([_part(0, content), *others]))


def _mode(model: ArmModel) -> int:
    return _RUNNING if model.power is Power.RUNNING else _OFF


def _joints(model: ArmModel) -> bytes:
    q, qd = model.drive.q.tolist(), model.drive.qd.tolist()
    usual = struct.pack(">ffffB", *_USUAL, _mode(model))
    return _part(1, b"".join(struct.pack(">ddd", a, a, v) + usual for a, v in zip(q, qd, strict=True)))


def _masterboard(model: ArmModel, analog_out: list[float]) -> bytes:
    digital = struct.pack(">II", model.digital_inputs, model.digital_outputs)
    analog = struct.pack(">bbddbbdd", 0, 0, 0.0, 0.0, 0, 0, *analog_out)
    supply = struct.pack(">ffff", 30.0, 48.0 if model.power is not Power.OFF else 0.0, 0.5, 0.0)
    safety = bytes((model.safety_mode, model.safety_mode == 2)) + bytes(8)
    return _part(3, digital + analog + supply + safety)


def _cartesian(model: ArmModel) -> bytes:
    """Pose of the tool in the base and of the tool on the flange."""
    drive = model.drive
    return _part(
        4, struct.pack(">12d", *pose_from_matrix(drive.base_from_tcp()), *pose_from_matrix(drive.flange_from_tcp))
    )


def _kinematics(table: Matrix) -> bytes:
    """The table that the controller computes with; a made-up checksum of each joint's row."""
    a, d, alpha, theta = table.T
    checksums = [zlib.crc32(row.tobytes()) for row in table]
    return _part(5, struct.pack(">6I24dI", *checksums, *theta, *a, *d, *alpha, _LINEARISED))


def _configuration(model: ArmModel) -> bytes:
    """Limits, defaults of the moves, the maker's own table and which model it is."""
    params = model.params
    limits = np.tile([-params.joint_limit, params.joint_limit], 6)
    motion = np.column_stack((params.speed_limits, np.full(6, 40.0))).ravel()
    a, d, alpha, theta = TABLES[params.model].T
    numbers = (*limits, *motion, 1.05, 1.4, 0.25, 1.2, 0.25, *a, *d, *alpha, *theta)
    return _part(6, struct.pack(">53d4i", *numbers, 3, 0, _MODELS[params.model], 1))


def _part(kind: int, content: bytes) -> bytes:
    return struct.pack(">IB", 5 + len(content), kind) + content


def _message(kind: int, content: bytes, time: float = 0.0) -> bytes:
    return _package(_MESSAGE, struct.pack(">Qbb", round(1e6 * time), -2, kind) + content)


def _package(kind: int, content: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(content), kind) + content


_PRIMARY, _SECONDARY, _REAL_TIME = (30001, 30011), (30002, 30012), (30003, 30013)
_READ_ONLY_PORTS = (30011, 30012, 30013)
SCRIPT_PORTS = (*_PRIMARY, *_SECONDARY, *_REAL_TIME)
_REPORT_EVERY = 50
"""Ticks between two reports on the primary and the secondary port, which come ten times a second."""


class ScriptClients:
    """All connections to `SCRIPT_PORTS` of one controller."""

    def __init__(self, model: ArmModel, program: ProgramMemory, view: RegisterView) -> None:
        self._model = model
        self._program = program
        self._view = view
        self._texts: dict[Client, ScriptCollector] = {}
        self._ports: dict[Client, int] = {}
        self._safety_mode = model.safety_mode

    def serve(self, port: int, client: Client, data: bytes | None) -> None:
        """`data` came from `client` of `port`: b"" for a new one, None for one that has left."""
        if data is None:
            self._texts.pop(client, None)
            self._ports.pop(client, None)
            return
        if client not in self._ports:
            self._ports[client] = port
            if port not in _REAL_TIME:
                client.send(version_message(VERSION))
        if port not in _READ_ONLY_PORTS:
            for text in self._texts.setdefault(client, ScriptCollector()).feed(data):
                self._take(text)

    def tick(self, count: int) -> None:
        """Tell everybody what is due in the cycle with this number."""
        changed = self._model.safety_mode != self._safety_mode
        self._safety_mode = self._model.safety_mode
        if not self._ports:
            self._program.announcements.clear()
            return
        time = self._model.time
        told = [message(one.kind, one.words, time, one.line, one.column) for one in self._program.announcements]
        self._program.announcements.clear()
        if changed:
            told.append(safety_message(self._safety_mode, time))
            if self._model.safety is Safety.PROTECTIVE_STOP:
                told.append(message("warning", f"Protective stop: {self._model.fault_text}", time))
        # A client that hears of a stop has a state that shows it.
        reports = changed or count % _REPORT_EVERY == 0
        state = packet = b""
        for client, port in self._ports.items():
            if port in _REAL_TIME:
                packet = packet or real_time_packet(self._view)
                client.offer(packet)
                continue
            if reports:
                state = state or robot_state(self._model, self._program.runtime_state, self._view.registers.analog_out)
                client.send(state)
            if told and port in _PRIMARY:
                client.send(b"".join(told))

    def _take(self, text: str) -> None:
        """A script, or one of the controller's own commands. In local control nothing is taken."""
        if not self._model.remote:
            self._program.announcements.append(Announcement("read-only", "the arm is in local control"))
            return
        match " ".join(text.split()).lower():
            case "power on":
                self._model.set_power(max(self._model.power, Power.IDLE))
            case "power off":
                self._program.stop("power off")
                self._model.set_power(Power.OFF)
            case "set robotmode run":
                self._model.set_power(Power.RUNNING)
            case "set unlock protective stop":
                self._model.unlock(at_once=True)
            case "stop program":
                self._program.stop("stopped by a client")
            case "pause program":
                self._program.pause()
            case _:
                self._program.load(text)
