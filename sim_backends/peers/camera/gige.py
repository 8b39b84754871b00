"""A camera on GigE Vision: answers on UDP port 3956 of a loopback address of its own, sends pictures where it is told.

One client controls it and others may read; a client that stays silent longer than its heartbeat loses control. Packets
that got lost are sent again when they are asked for. It listens to its own address alone, so no broadcast finds it, and
sends nothing to another destination than a loopback address.
"""

import contextlib
import os
import socket
import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim_backends.clock import WorldClock
from sim_backends.models.camera import CameraSpec, CameraState
from sim_backends.peers.camera import gigevision
from sim_backends.peers.camera import gigevision as memory
from sim_backends.peers.camera.frames import Exposure, FrameSession, Rejected, Render

_KEPT = 8
"""Pictures whose packets can be asked for again."""
_BURST = 60_000
"""Bytes that are sent at once; the receiver's buffer may hold little more. A pause follows."""
_PAUSE_S = 0.0005


class GigeStream:
    """Sends from the address `host` what the registers in `read` say: format, region, gain, packet size, destination.
    `lost(number of a packet in its picture)` decides which packets get lost on their first way."""

    def __init__(self, host: str, read: gigevision.GigeMemory) -> None:
        self.lost: Callable[[int], bool] = lambda number: False
        self._read = read
        self._sent: OrderedDict[int, list[bytes]] = OrderedDict()
        self._keeping = threading.Lock()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, 0))

    def close(self) -> None:
        """Send nothing more."""
        self._socket.close()

    def forget(self) -> None:
        """Keep no packets of earlier pictures: block ids begin anew."""
        with self._keeping:
            self._sent.clear()

    def test(self) -> None:
        """One packet of the size that is set, to see whether it arrives."""
        self._put(gigevision.test_packet(self._packet_size))

    def send(self, image: NDArray[np.uint8], block_id: int, timestamp: int) -> None:
        """Send the region of the sensor's `image` (height, width); `timestamp` in ticks of the device's clock."""
        read = self._read
        left, top, width, height = (read.word(a) for a in (memory.LEFT, memory.TOP, memory.WIDTH, memory.HEIGHT))
        code = read.word(memory.PIXEL_FORMAT)
        part = image[top : top + height, left : left + width]
        if gain := read.real(memory.GAIN):
            part = np.minimum(part * 10.0 ** (gain / 20.0), 255.0).astype(np.uint8)
        pixels = gigevision.ENCODERS[code][2](np.ascontiguousarray(part))
        leader = gigevision.Leader(timestamp, code, width, height=height, left=left, top=top)
        made = list(gigevision.packets(block_id, leader, pixels, self._packet_size))
        with self._keeping:
            self._sent[block_id] = made
            while len(self._sent) > _KEPT:
                self._sent.popitem(last=False)
        size = 0
        for number, packet in enumerate(made):
            if not self.lost(number):
                self._put(packet)
            size += len(packet)
            if size > _BURST:
                time.sleep(_PAUSE_S)
                size = 0

    def send_again(self, block_id: int, first: int, last: int) -> None:
        """Send these packets of a picture again, if they are still known."""
        with self._keeping:
            again = self._sent.get(block_id, [])[first : last + 1]
        for packet in again:
            self._put(packet)

    @property
    def _packet_size(self) -> int:
        return self._read.word(memory.PACKET_SIZE) & 0xFFFF

    def _put(self, packet: bytes) -> None:
        host = socket.inet_ntoa(struct.pack(">I", self._read.word(memory.STREAM_ADDRESS)))
        if host.startswith("127."):
            # Nobody may be listening any more; a camera does not mind.
            with contextlib.suppress(OSError):
                self._socket.sendto(packet, (host, self._read.word(memory.STREAM_PORT) & 0xFFFF))


_FIRE = 1 << 31
_LATCH = 2
Address = tuple[str, int]


class GigePeer:
    """Serves one camera at `address`, an address in 127.0.0.0/8."""

    def __init__(self, name: str, clock: WorldClock, render: Render, spec: CameraSpec) -> None:
        """Bind on the first free address of this process; OSError when none is. `render` is called in the session's
        thread, once the exposure that it is to show is over; it gives the whole sensor."""
        self.name = name
        self.camera = CameraState(spec)
        self._clock = clock
        self._control, self.address = _bound()
        self._memory = gigevision.GigeMemory(spec, self.address)
        self._stream = GigeStream(self.address, self._memory)
        self._session = FrameSession(name, self.camera, clock, render, self._send)
        self._controller: Address | None = None
        self._heard = 0.0
        self._first = 1
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=f"{name}-control", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._session.start()
        self._thread.start()

    def stop(self) -> None:
        """End all threads and release the address; idempotent."""
        self._stopping.set()
        self._session.end()
        if self._thread.ident is not None:
            self._thread.join()
            self._session.join()
        self._control.close()
        self._stream.close()

    def fault(self, name: str, count: int = 1) -> None:
        """Cause a fault (see `CameraState.fault`); ValueError for another name."""
        self.camera.fault(name, count)

    def clear(self) -> None:
        """Take away all faults."""
        self.camera.clear()
        self.lose_packets(lambda number: False)

    def lose_packets(self, lost: Callable[[int], bool]) -> None:
        """From now on a packet is lost when `lost(its number in the picture)`; one that is sent again is not."""
        self._stream.lost = lost

    def drop_controller(self) -> None:
        """Forget who controls the camera, as after a short loss of its power."""
        self._release()

    def pulse(self) -> None:
        """A pulse on Line1."""
        if self._memory.word(memory.TRIGGER_SOURCE) == memory.LINE:
            self._trigger()

    def _serve(self) -> None:
        self._control.settimeout(0.1)
        while not self._stopping.is_set():
            try:
                packet, client = self._control.recvfrom(2048)
            except TimeoutError:
                packet, client = b"", ("", 0)
            except OSError:
                return
            timeout = 1e-3 * self._memory.word(memory.HEARTBEAT)
            if self._controller is not None and time.monotonic() - self._heard > timeout:
                self._release()
            request = gigevision.GvcpRequest.of(packet)
            if request is None or self.camera.silent:
                continue
            if client == self._controller:
                self._heard = time.monotonic()
            try:
                answer = request.reply(self._answer(request, client))
            except gigevision.GvcpRefused as refused:
                answer = request.reply(status=refused.status)
            if request.answered:
                with contextlib.suppress(OSError):
                    self._control.sendto(answer, client)

    def _release(self) -> None:
        self._controller = None
        self._session.halt()
        for address in (memory.CONTROL, memory.CONTROLLER_PORT, memory.CONTROLLER_ADDRESS):
            self._memory.set_word(address, 0)

    def _answer(self, request: gigevision.GvcpRequest, client: Address) -> bytes:
        if request.command == gigevision.GvcpCommand.DISCOVERY:
            return self._memory.read(0, 0xF8)
        if request.command == gigevision.GvcpCommand.READ_REGISTERS:
            return b"".join(self._memory.read(address, 4) for address in request.words())
        if request.command == gigevision.GvcpCommand.READ_MEMORY:
            address, size = struct.unpack(">II", request.data)
            return request.data[:4] + self._memory.read(address, size & 0xFFFF)
        if request.command == gigevision.GvcpCommand.RESEND:
            _, block_id, first, last = struct.unpack_from(">HHII", request.data)
            self._stream.send_again(block_id, first & 0xFFFFFF, last & 0xFFFFFF)
            return b""
        if request.command not in (gigevision.GvcpCommand.WRITE_REGISTERS, gigevision.GvcpCommand.WRITE_MEMORY):
            raise gigevision.GvcpRefused(gigevision.GvcpStatus.NOT_IMPLEMENTED)
        if self._controller not in (None, client):
            raise gigevision.GvcpRefused(gigevision.GvcpStatus.ACCESS_DENIED)
        if request.command == gigevision.GvcpCommand.WRITE_REGISTERS:
            words = request.words()
            for address, value in zip(words[::2], words[1::2], strict=True):
                self._write(address, struct.pack(">I", value), client)
            return struct.pack(">I", len(words) // 2)
        self._write(struct.unpack_from(">I", request.data)[0], request.data[4:], client)
        return struct.pack(">I", len(request.data) - 4)

    def _write(self, address: int, data: bytes, client: Address) -> None:
        if self._controller is None and address != memory.CONTROL:
            raise gigevision.GvcpRefused(gigevision.GvcpStatus.ACCESS_DENIED)
        if self._session.running and address in (memory.WIDTH, memory.HEIGHT, memory.PIXEL_FORMAT):
            raise gigevision.GvcpRefused(gigevision.GvcpStatus.WRITE_PROTECT)
        value = struct.unpack(">I", data)[0] if len(data) == 4 else 0
        if address == memory.PACKET_SIZE and value & _FIRE:
            value &= ~_FIRE
            self._memory.write(address, struct.pack(">I", value))
            self._stream.test()
            return
        self._memory.write(address, data)
        if address == memory.CONTROL:
            if value:
                self._controller, self._heard = client, time.monotonic()
                self._memory.set_word(memory.CONTROLLER_PORT, client[1])
                self._memory.set_word(memory.CONTROLLER_ADDRESS, struct.unpack(">I", socket.inet_aton(client[0]))[0])
            else:
                self._release()
        elif address == memory.TIMESTAMP_CONTROL and value & _LATCH:
            self._memory.set_time(self.camera.spec.device_ns(self._clock.now()))
        elif address == memory.ACQUISITION:
            self._acquire(bool(value))
        elif address == memory.TRIGGER_SOFTWARE and self._memory.word(memory.TRIGGER_SOURCE) == memory.SOFTWARE:
            self._trigger()

    def _acquire(self, wanted: bool) -> None:
        self._session.halt()
        self._stream.forget()
        self._memory.set_word(memory.ACQUISITION, int(wanted))
        if wanted:
            self._first = self.camera.next_frame_id
            self.camera.exposure = 1e-6 * self._memory.real(memory.EXPOSURE)
            self.camera.frame_rate = min(self._memory.real(memory.FRAME_RATE), 1.0 / self.camera.exposure)
            if not self._memory.word(memory.TRIGGER_MODE):
                self._session.run(self.camera.frame_rate)

    def _trigger(self) -> None:
        if self._memory.word(memory.ACQUISITION) and self._memory.word(memory.TRIGGER_MODE):
            # A trigger during an exposure is lost, as in a real camera.
            with contextlib.suppress(Rejected):
                self._session.trigger()

    def _send(self, exposure: Exposure, image: NDArray[np.uint8]) -> None:
        if self.camera.silent or self._controller is None:
            return
        spec = self.camera.spec
        # Block ids have 16 bits and none is 0.
        block_id = (exposure.frame_id - self._first) % 0xFFFF + 1
        self._stream.send(image, block_id, spec.device_ns(exposure.begin + spec.latency))


def _bound() -> tuple[socket.socket, str]:
    """A socket on the first of 127.1.n.2 … 127.1.n.254 that is free; n follows from the process."""
    net = os.getpid() % 250
    problem: OSError | None = None
    for candidate in (f"127.1.{net}.{i}" for i in range(2, 255)):
        bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            bound.bind((candidate, gigevision.PORT))
        except OSError as error:
            bound.close()
            problem = error
            continue
        return bound, candidate
    raise OSError(f"UDP port {gigevision.PORT} is not free on 127.1.{net}.2 …: stop the other simulator ({problem})")
