"""Pictures from one camera while it acquires: the library's stream, emptied by one thread.

A stream lives as long as the acquisition, so no picture of an earlier one can be taken for a new one. A picture of
which packets are missing is dropped and counted; the gap in the block ids tells of it.

Pixels become 8-bit grey. Formats and their numbers are those of the Pixel Format Naming Convention (EMVA, 2.1); the two
packings of GigE Vision ("Packed") differ from the convention's own ("p"). Of more than 8 bits the highest 8 count."""

import ctypes
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.camera.genicam.aravis import Aravis, AravisError, BufferStatus, Handle
from drivers.camera.genicam.device import GenicamDevice
from drivers.camera.genicam.make import GigeCameraConfig
from drivers.errors import CellError
from drivers.interfaces import Image, LinkStatistics

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class PixelFormat:
    """A format: its number on the wire, bits a pixel, and what makes (height, width) grey of its bytes."""

    code: int
    bits: int
    grey: Callable[[Bytes, int, int], Image]


def _mono8(data: Bytes, height: int, width: int) -> Image:
    return data.reshape(height, width)


def _high_byte(shift: int) -> Callable[[Bytes, int, int], Image]:
    """Unpacked pixels of two bytes, little-endian, of which `shift` bits are below the highest 8."""

    def grey(data: Bytes, height: int, width: int) -> Image:
        return (data.view("<u2") >> shift).astype(np.uint8).reshape(height, width)

    return grey


def _packed(data: Bytes, height: int, width: int) -> Image:
    """GigE Vision's packing: two pixels in three bytes, the highest 8 bits of each in the first and the last."""
    return np.ascontiguousarray(data.reshape(-1, 3)[:, ::2]).reshape(-1)[: height * width].reshape(height, width)


def _mono10p(data: Bytes, height: int, width: int) -> Image:
    """Four pixels in five bytes, the lowest bits first."""
    five = data.reshape(-1, 5).astype(np.uint16)
    high = [(five[:, k] >> (2 + 2 * k)) | (five[:, k + 1] << (6 - 2 * k)) for k in range(4)]
    return np.stack(high, axis=1).astype(np.uint8).reshape(-1)[: height * width].reshape(height, width)


def _mono12p(data: Bytes, height: int, width: int) -> Image:
    """Two pixels in three bytes, the lowest bits first."""
    three = data.reshape(-1, 3)
    high = np.empty((len(three), 2), np.uint8)
    high[:, 0] = (three[:, 0] >> 4) | (three[:, 1] << 4)
    high[:, 1] = three[:, 2]
    return high.reshape(-1)[: height * width].reshape(height, width)


def _colour(code: int, channels: int) -> Callable[[Bytes, int, int], Image]:
    """Through OpenCV's conversion `code`."""

    def grey(data: Bytes, height: int, width: int) -> Image:
        shape = (height, width) if channels == 1 else (height, width, channels)
        return cv2.cvtColor(data.reshape(shape), code).astype(np.uint8, copy=False)

    return grey


# OpenCV names a Bayer pattern by its second row's second and third pixel, the convention by its first row's first two.
FORMATS = {
    "Mono8": PixelFormat(0x01080001, 8, _mono8),
    "Mono10": PixelFormat(0x01100003, 16, _high_byte(2)),
    "Mono10Packed": PixelFormat(0x010C0004, 12, _packed),
    "Mono10p": PixelFormat(0x010A0046, 10, _mono10p),
    "Mono12": PixelFormat(0x01100005, 16, _high_byte(4)),
    "Mono12Packed": PixelFormat(0x010C0006, 12, _packed),
    "Mono12p": PixelFormat(0x010C0047, 12, _mono12p),
    "Mono16": PixelFormat(0x01100007, 16, _high_byte(8)),
    "BayerGR8": PixelFormat(0x01080008, 8, _colour(cv2.COLOR_BayerGB2GRAY, 1)),
    "BayerRG8": PixelFormat(0x01080009, 8, _colour(cv2.COLOR_BayerBG2GRAY, 1)),
    "BayerGB8": PixelFormat(0x0108000A, 8, _colour(cv2.COLOR_BayerGR2GRAY, 1)),
    "BayerBG8": PixelFormat(0x0108000B, 8, _colour(cv2.COLOR_BayerRG2GRAY, 1)),
    "RGB8": PixelFormat(0x02180014, 24, _colour(cv2.COLOR_RGB2GRAY, 3)),
    "BGR8": PixelFormat(0x02180015, 24, _colour(cv2.COLOR_BGR2GRAY, 3)),
}
"""The formats that can be configured, by the convention's names."""
NAMES = {known.code: name for name, known in FORMATS.items()}


def size_in_bytes(name: str, height: int, width: int) -> int:
    """How many bytes a picture has without padding; a group of packed pixels is always whole."""
    group = {"Mono10Packed": (2, 3), "Mono12Packed": (2, 3), "Mono12p": (2, 3), "Mono10p": (4, 5)}.get(name)
    if group is None:
        return height * width * FORMATS[name].bits // 8
    pixels, size = group
    return -(-height * width // pixels) * size


def to_grey(name: str, data: Bytes, height: int, width: int) -> Image:
    """The picture (height, width) uint8 of `data`, bytes in the format `name`; ValueError when there are too few."""
    expected = size_in_bytes(name, height, width)
    if len(data) < expected:
        raise ValueError(f"a picture of {width}x{height} pixels in {name} has {len(data)} of {expected} bytes")
    return FORMATS[name].grey(data[:expected], height, width)


_POP_US = 10_000
_FIXED = 0
_SOCKET_BUFFER = 4 * 1024 * 1024
_IMAGE = 1
_STOP_WALL_S = 0.5
_WRAP = 0xFFFF
"""Block ids of 16 bits run from 1 to this and begin again at 1; longer ones do not wrap in a lifetime."""


@dataclass(frozen=True)
class AcquiredPicture:
    """A complete picture; `device_ns` is the camera's time stamp, `count` counts its exposures in this acquisition."""

    image: Image
    count: int
    device_ns: int


class BlockCount:
    """Block ids as a count: 1 for the first picture of the acquisition. A picture that comes out of turn counts less
    than the one before it."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._count = 0

    def of(self, block_id: int) -> int:
        """The count of the next picture that came."""
        if self._last is None:
            self._count = 1
        elif block_id < self._last - _WRAP // 2 and self._last <= _WRAP:
            self._count += block_id - self._last + _WRAP
        elif block_id > self._last + _WRAP // 2 and block_id <= _WRAP:
            # Out of turn, from before the ids began again.
            self._count += block_id - self._last - _WRAP
        else:
            self._count += block_id - self._last
        self._last = block_id
        return self._count


class Acquisition:
    """An acquisition from `start` to `stop`; `take(picture)` is called in its thread, `failed()` when it ended badly.
    `failure` is then why; `incomplete` counts the pictures that were dropped because packets were missing."""

    def __init__(
        self, device: GenicamDevice, network: GigeCameraConfig | None, buffers: int,
        take: Callable[[AcquiredPicture], None], failed: Callable[[], None], statistics: LinkStatistics,
    ) -> None:  # fmt: skip
        self.failure: CellError | None = None
        self.incomplete = 0
        self._device = device
        self._library: Aravis = device.library
        self._take = take
        self._failed = failed
        self._statistics = statistics
        self._ids = BlockCount()
        self._ended = threading.Event()
        self._stopping = threading.Lock()
        payload = int(device.call("get_payload"))
        self._stream = device.call("create_stream", None, None)
        if network is not None:
            self._set_network(network)
        for _ in range(buffers):
            self._push(self._library.plain("arv_buffer_new_allocate", payload))
        self._thread = threading.Thread(target=self._empty, name=f"{device.name} pictures", daemon=True)

    def start(self) -> None:
        """Let the camera acquire."""
        self._thread.start()
        self._device.call("start_acquisition")

    def stop(self) -> None:
        """End it; a camera that is lost is not asked. Idempotent."""
        with self._stopping:
            if not self._ended.is_set():
                self._stop()

    def _stop(self) -> None:
        try:
            if self.failure is None and self._device.held and self._device.open:
                self._ask_for_the_end()
        finally:
            self._ended.set()
            if self._thread.ident is not None:
                self._thread.join()
            self._count_packets()
            # The library tells the camera that its stream is over, which takes seconds where nobody answers.
            giver = threading.Thread(target=self._library.plain, args=("g_object_unref", self._stream), daemon=True)
            giver.start()
            if self._device.open and self.failure is None:
                giver.join()

    def _ask_for_the_end(self) -> None:
        """Who ends a sweep has a laser to switch off: it waits for no camera that is silent."""
        failed: list[CellError] = []

        def ask() -> None:
            try:
                self._device.call("stop_acquisition")
            except CellError as error:
                failed.append(error)

        asker = threading.Thread(target=ask, name=f"{self._device.name} stop", daemon=True)
        asker.start()
        asker.join(_STOP_WALL_S)
        if asker.is_alive():
            self._device.abandon()
            raise self._device.lost(f"no answer to the end of its acquisition within {_STOP_WALL_S:g} s")
        if failed:
            raise failed[0]

    def _set_network(self, network: GigeCameraConfig) -> None:
        for name, kind, value in (
            ("packet-resend", "gv_stream_packet_resend", int(network.resend)),
            # All of a picture's packets may be asked for again, not only a quarter of them.
            ("packet-request-ratio", "double", 1.0),
            ("packet-timeout", "uint", round(network.packet_timeout * 1e6)),
            ("frame-retention", "uint", round(network.retention * 1e6)),
            # What arrives while this computer is busy has to wait somewhere; the system may allow less.
            ("socket-buffer", "gv_stream_socket_buffer", _FIXED),
            ("socket-buffer-size", "int", _SOCKET_BUFFER),
        ):
            self._library.set_property(self._stream, name, kind, value)

    def _push(self, buffer: Handle) -> None:
        self._library.plain("arv_stream_push_buffer", self._stream, buffer)

    def _empty(self) -> None:
        while not self._ended.is_set():
            buffer = self._library.plain("arv_stream_timeout_pop_buffer", self._stream, _POP_US)
            try:
                if buffer is not None:
                    self._look_at(buffer)
                elif not self._device.held:
                    raise self._device.lost("its heartbeat got no answer, or another application took control")
            except Exception as error:
                # Whatever it was, no picture comes any more, and whoever waits for one has to be told.
                self.failure = error if isinstance(error, CellError) else self._device.lost(str(error))
                self._failed()
                return
            finally:
                if buffer is not None:
                    self._push(buffer)

    def _look_at(self, buffer: Handle) -> None:
        library = self._library
        status = BufferStatus(library.plain("arv_buffer_get_status", buffer))
        if status is not BufferStatus.SUCCESS:
            if status in (
                BufferStatus.TIMEOUT,
                BufferStatus.MISSING_PACKETS,
                BufferStatus.WRONG_PACKET_ID,
                BufferStatus.SIZE_MISMATCH,
            ):
                self.incomplete += 1
                self._statistics.count("frames_incomplete")
                self._failed()
            return
        if (kind := library.plain("arv_buffer_get_payload_type", buffer)) != _IMAGE:
            raise ValueError(f"it sends payload type {kind} instead of plain pictures; switch chunks and multipart off")
        self._take(
            AcquiredPicture(
                self._image(buffer),
                self._ids.of(library.plain("arv_buffer_get_frame_id", buffer)),
                library.plain("arv_buffer_get_timestamp", buffer),
            )
        )

    def _image(self, buffer: Handle) -> Image:
        library = self._library
        x, y, width, height = (ctypes.c_int() for _ in range(4))
        library.plain("arv_buffer_get_image_region", buffer, *map(ctypes.byref, (x, y, width, height)))
        across, down = ctypes.c_int(), ctypes.c_int()
        library.plain("arv_buffer_get_image_padding", buffer, ctypes.byref(across), ctypes.byref(down))
        if across.value or down.value:
            raise ValueError(f"its lines are padded by {across.value} bytes, which is not read; choose another width")
        code = library.plain("arv_buffer_get_image_pixel_format", buffer)
        if code not in NAMES:
            raise ValueError(
                f"it sends pixel format 0x{code:08x}, which is not known; known: {', '.join(NAMES.values())}"
            )
        size = ctypes.c_size_t()
        address = library.plain("arv_buffer_get_data", buffer, ctypes.byref(size))
        # A copy: the buffer is filled again.
        data = np.frombuffer(ctypes.string_at(address, size.value), np.uint8)
        return to_grey(NAMES[code], data, height.value, width.value)

    def _count_packets(self) -> None:
        with suppress(AravisError):
            for index in range(self._library.plain("arv_stream_get_n_infos", self._stream)):
                name = self._library.plain("arv_stream_get_info_name", self._stream, index).decode()
                if name in ("n_resent_packets", "n_missing_packets", "n_underruns"):
                    count = self._library.plain("arv_stream_get_info_uint64", self._stream, index)
                    if count:
                        key = name.removeprefix("n_")
                        self._statistics.errors[key] = self._statistics.errors.get(key, 0) + count
