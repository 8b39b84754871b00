"""A folder of recorded pictures as a camera: its image files in the order of their names, each once.

For measuring on recordings. There is no exposure to wait for: times are those of the delivery.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from drivers.clock import Clock
from drivers.errors import Aborted, DeviceFault, NotConnectedError, RefusedError
from drivers.interfaces import Frame, Identity, Image, LinkStatistics
from drivers.quantities import check_positive

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
_PNG_END = b"IEND\xaeB`\x82"
_JPEG_END = b"\xff\xd9"


def read_image(path: Path, shape: tuple[int, int] | None = None) -> Image:
    """The picture in `path` as grey (height, width) uint8.

    Raises `RefusedError` naming the file when it is missing, no picture, cut off, or not of `shape`. The end mark is
    looked for because the decoder fills the missing part of a cut file with grey and says nothing.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RefusedError(f"{path}: cannot be read: {error.strerror}. Check the file") from error
    if _is_cut(data):
        raise RefusedError(f"{path}: is cut off after {len(data)} bytes. Copy it again")
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    if decoded is None:
        raise RefusedError(f"{path}: is not a picture that can be read ({len(data)} bytes). Take it again")
    image: Image = decoded.astype(np.uint8, copy=False)
    if shape is not None and image.shape != shape:
        raise RefusedError(
            f"{path}: has {image.shape[1]}x{image.shape[0]} pixels instead of {shape[1]}x{shape[0]}. "
            "Keep pictures of one camera and one format in a folder"
        )
    return image


def image_files(folder: Path) -> list[Path]:
    """The image files of `folder`, sorted so that numbers in their names count as numbers: 2 before 10."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
    return sorted(files, key=lambda path: [int(part) if part.isdigit() else part for part in _parts(path.name)])


class FolderCamera:
    """Delivers the image files of `folder`; `shape` (height, width) defaults to that of the first readable file.

    Raises `NotConnectedError` when the folder or a readable picture is missing. A bad file raises `RefusedError` when
    its turn comes; the next call goes on with the next file.
    """

    def __init__(self, name: str, folder: Path, *, clock: Clock, shape: tuple[int, int] | None = None) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self.lost = 0
        self._folder = folder
        self._clock = clock
        self._period = 0.0
        if not folder.is_dir():
            raise NotConnectedError(name, f"{folder} is not a folder. Check the path")
        self._files = image_files(folder)
        self._position = 0
        self._stopped = False
        self.shape = shape or self._first_shape()

    def identity(self) -> Identity:
        """The folder as the address; recordings have no serial number."""
        return Identity("folder", "", "", str(self._folder))

    @property
    def time_bound(self) -> float:
        """Unlimited: nothing tells when a recorded picture was exposed."""
        return math.inf

    def ping(self) -> float:
        """Look at the folder; returns the wall seconds it took."""
        before = self._clock.now()
        if not self._folder.is_dir():
            raise NotConnectedError(self.name, f"{self._folder} is gone. Check the path")
        seconds = self._clock.wall(self._clock.now() - before)
        self.statistics.add_round_trip(seconds)
        return seconds

    def configure(self, exposure: float, frame_rate: float) -> None:
        """A recording's exposure is what it was; `frame_rate` (Hz) spaces the device times of the frames."""
        check_positive(self.name, "exposure", exposure, 3600.0, "s")
        self._period = 1.0 / check_positive(self.name, "frame rate", frame_rate, 1e6, "Hz")

    def grab(self, timeout: float = 2.0) -> Frame:
        """The next picture; `RefusedError` for a bad file, `DeviceFault` (camera.end_of_folder) after the last."""
        if self._position >= len(self._files):
            raise DeviceFault(
                self.name,
                "camera.end_of_folder",
                f"all {len(self._files)} pictures of {self._folder} have been delivered",
                recoverable=False,
                hint="Record more pictures or ask for fewer.",
            )
        index = self._position
        self._position += 1
        image = read_image(self._files[index], self.shape)
        now = self._clock.now()
        return Frame(image, index, 0.0, device_time=index * self._period, host_time=now, received=now)

    @contextmanager
    def stream(self) -> Iterator[FolderCamera]:
        """The remaining pictures as a stream; nothing is ever lost from a folder."""
        self._stopped = False
        try:
            yield self
        finally:
            self._stopped = True

    def next(self, timeout: float) -> Frame:
        """The next picture of the open stream; raises as `grab`, and `Aborted` once it was stopped."""
        if self._stopped:
            raise Aborted(f"{self.name}: the acquisition was stopped")
        return self.grab(timeout)

    def __iter__(self) -> Iterator[Frame]:
        """Pictures until the last file or the end of the stream."""
        while self._position < len(self._files) and not self._stopped:
            yield self.next(0.0)

    def stop(self) -> None:
        """End an open stream."""
        self._stopped = True

    def close(self) -> None:
        """Deliver nothing more."""
        self._stopped = True
        self._position = len(self._files)

    def _first_shape(self) -> tuple[int, int]:
        reasons = []
        for path in self._files:
            try:
                height, width = read_image(path).shape
                return height, width
            except RefusedError as error:
                reasons.append(str(error))
        what = f"none of its {len(reasons)} pictures can be read ({reasons[0]})" if reasons else "it has no pictures"
        raise NotConnectedError(self.name, f"{self._folder}: {what}. Known are {', '.join(SUFFIXES)}")


def _is_cut(data: bytes) -> bool:
    if data.startswith(b"\x89PNG"):
        return _PNG_END not in data[-64:]
    if data.startswith(b"\xff\xd8"):
        return _JPEG_END not in data[-1024:]
    if data.startswith(b"BM"):
        return len(data) < int.from_bytes(data[2:6], "little")
    return False


def _parts(name: str) -> list[str]:
    return re.split(r"(\d+)", name.lower())
