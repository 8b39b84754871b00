"""The pictures of a simulated GigE Vision camera on their way: packets to where the client wants them, and again.

Nothing leaves this computer: another destination than a loopback address gets nothing.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim_backends.peers.camera import gige_registers as memory
from sim_backends.peers.camera.gige_memory import GigeMemory
from sim_backends.peers.camera.gige_pixels import ENCODERS
from sim_backends.peers.camera.gvcp import Leader, packets, test_packet

_KEPT = 8
"""Pictures whose packets can be asked for again."""
_BURST = 60_000
"""Bytes that are sent at once; the receiver's buffer may hold little more. A pause follows."""
_PAUSE_S = 0.0005


class GigeStream:
    """Sends from the address `host` what the registers in `read` say: format, region, gain, packet size, destination.

    `lost(number of a packet in its picture)` decides which packets get lost on their first way.
    """

    def __init__(self, host: str, read: GigeMemory) -> None:
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
        self._put(test_packet(self._packet_size))

    def send(self, image: NDArray[np.uint8], block_id: int, timestamp: int) -> None:
        """Send the region of the sensor's `image` (height, width); `timestamp` in ticks of the device's clock."""
        read = self._read
        left, top, width, height = (read.word(a) for a in (memory.LEFT, memory.TOP, memory.WIDTH, memory.HEIGHT))
        code = read.word(memory.PIXEL_FORMAT)
        part = image[top : top + height, left : left + width]
        if gain := read.real(memory.GAIN):
            part = np.minimum(part * 10.0 ** (gain / 20.0), 255.0).astype(np.uint8)
        pixels = ENCODERS[code][2](np.ascontiguousarray(part))
        leader = Leader(timestamp, code, width, height=height, left=left, top=top)
        made = list(packets(block_id, leader, pixels, self._packet_size))
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
