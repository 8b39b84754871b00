"""A folder of recorded pictures with their times, played again at the pace at which it was taken.

`times.csv` beside the pictures has the columns file, time_s (start of the exposure), exposure_s and, where pictures
were lost, frame (the number of the exposure). The recording's clock is laid on the host's anew when an acquisition
begins. How that lies to other devices' clocks nobody knows, so its times are unlimited in their error."""

import csv
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from drivers.camera.frame_queue import alone
from drivers.clock import Clock
from drivers.errors import (
    Aborted,
    ConfigError,
    DeadlineError,
    DeviceFault,
    LimitError,
    NotConnectedError,
    RefusedError,
    shown,
)
from drivers.interfaces import Frame, Identity, Image, LinkStatistics

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


def _is_cut(data: bytes) -> bool:
    if data.startswith(b"\x89PNG"):
        return _PNG_END not in data[-64:]
    if data.startswith(b"\xff\xd8"):
        return _JPEG_END not in data[-1024:]
    if data.startswith(b"BM"):
        return len(data) < int.from_bytes(data[2:6], "little")
    return False


TIMES = "times.csv"
_EXPOSURE_AS_RECORDED, _RATE_AS_RECORDED = 0.02, 0.05


@dataclass(frozen=True)
class Recorded:
    """One picture: its file, start and length of its exposure in s, and the number of the exposure."""

    file: Path
    time: float
    exposure: float
    number: int


def read_times(folder: Path) -> list[Recorded]:
    """The pictures of `folder` in the order of their times. Raises `ConfigError` naming the line that is wrong."""
    path = folder / TIMES
    rows: list[Recorded] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as text:
            for line, row in enumerate(csv.DictReader(text), 2):
                try:
                    made = Recorded(
                        folder / row["file"],
                        float(row["time_s"]),
                        float(row["exposure_s"]),
                        int(row.get("frame") or line - 1),
                    )
                    if not (math.isfinite(made.time) and made.exposure > 0.0):
                        raise ValueError(f"time {made.time:g} s, exposure {made.exposure:g} s")
                except (KeyError, TypeError, ValueError) as error:
                    raise ConfigError(
                        f"{path}, line {line}: {error!r}. Write the columns file, time_s, exposure_s and perhaps frame"
                    ) from error
                if rows and (made.time <= rows[-1].time or made.number <= rows[-1].number):
                    raise ConfigError(f"{path}, line {line}: time and frame must grow from line to line. Sort it")
                rows.append(made)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}. Write the pictures' times there") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: is no table of text: {error}. Write it as CSV in UTF-8") from error
    if len(rows) < 2:
        raise ConfigError(f"{path}: has {len(rows)} pictures (allowed: at least 2). Record more")
    return rows


class RecordedCamera:
    """Plays the pictures of `folder`, each once; `shape` (height, width) is what they have to have. Raises
    `ConfigError` for a recording that cannot be read, `NotConnectedError` when the folder is missing."""

    def __init__(self, name: str, folder: Path, *, clock: Clock, shape: tuple[int, int]) -> None:
        self.name = name
        self.shape = shape
        self.lost = 0
        self.statistics = LinkStatistics()
        self._folder = folder
        self._clock = clock
        if not folder.is_dir():
            raise NotConnectedError(name, f"{folder} is not a folder. Check the path")
        self._rows = read_times(folder)
        read_image(self._rows[0].file, shape)
        steps = np.diff([row.time for row in self._rows]) / np.diff([row.number for row in self._rows])
        self.frame_rate = 1.0 / float(np.median(steps))
        self._position = 0
        self._begun = 0.0
        self._last: int | None = None
        self._acquiring = threading.Lock()
        self._stopped = threading.Event()
        self._closed = False

    def identity(self) -> Identity:
        """The folder as the address; a recording has no serial number."""
        return Identity("recording", "", "", str(self._folder))

    @property
    def time_bound(self) -> float:
        """Unlimited: nothing tells how the recording's clock lies to other devices'."""
        return math.inf

    def ping(self) -> float:
        """Look at the folder; returns the wall seconds it took."""
        before = self._clock.now()
        if self._closed or not self._folder.is_dir():
            raise NotConnectedError(self.name, f"{self._folder} is closed or gone. Check the path, open it again")
        seconds = self._clock.wall(self._clock.now() - before)
        self.statistics.add_round_trip(seconds)
        return seconds

    def configure(self, exposure: float, frame_rate: float) -> None:
        """A recording is what it was: `LimitError` for another exposure (s, to 2 %) or frame rate (Hz, to 5 %)."""
        with self._exclusive():
            recorded = [row.exposure for row in self._rows]
            low, high = min(recorded), max(recorded)
            if not (1 - _EXPOSURE_AS_RECORDED) * high <= exposure <= (1 + _EXPOSURE_AS_RECORDED) * low:
                raise LimitError(
                    self.name,
                    f"exposure {shown(exposure, 's')} is not that of the recording in {self._folder} (allowed: "
                    f"{shown(low, 's')} to {shown(high, 's')}). Ask for what was recorded, or record again",
                )
            if abs(frame_rate / self.frame_rate - 1.0) > _RATE_AS_RECORDED:
                raise LimitError(
                    self.name,
                    f"frame rate {frame_rate:g} Hz is not that of the recording in {self._folder} (allowed: "
                    f"{self.frame_rate:.4g} Hz). Ask for what was recorded, or record again",
                )

    def grab(self, timeout: float = 2.0) -> Frame:
        """The next picture, as if its exposure began now; `DeviceFault` (camera.end_of_folder) after the last."""
        with self._exclusive():
            self._begin()
            return self.next(timeout)

    @contextmanager
    def stream(self) -> Iterator[Self]:
        """The remaining pictures, the first one's exposure beginning now."""
        with self._exclusive():
            self._begin()
            try:
                yield self
            finally:
                self._stopped.set()

    def next(self, timeout: float) -> Frame:
        """The next picture when its exposure would be over.

        Raises `DeadlineError` when that is not within `timeout` s, `Aborted` once it was stopped, `RefusedError` for a
        bad file, after which the next call goes on with the next one.
        """
        if self._position >= len(self._rows):
            raise DeviceFault(
                self.name,
                "camera.end_of_folder",
                f"all {len(self._rows)} pictures of {self._folder} have been played",
                recoverable=False,
                hint="Record more pictures or ask for fewer.",
            )
        row = self._rows[self._position]
        due = self._begun + row.time + row.exposure
        if self._clock.wait(self._stopped, min(due - self._clock.now(), timeout)):
            raise Aborted(f"{self.name}: the acquisition was stopped")
        if self._clock.now() < due:
            raise DeadlineError(
                self.name, f"no frame within {timeout:.3g} s. The recording has a gap here; wait longer"
            )
        self._position += 1
        image = read_image(row.file, self.shape)
        lost = 0 if self._last is None else row.number - self._last - 1
        self._last = row.number
        self.lost += lost
        return Frame(
            image, row.number, row.exposure, device_time=row.time, host_time=self._begun + row.time,
            received=self._clock.now(), lost_before=lost,
        )  # fmt: skip

    def __iter__(self) -> Iterator[Frame]:
        """Pictures until the last one or the end of the stream."""
        while self._position < len(self._rows) and not self._stopped.is_set():
            yield self.next(math.inf)

    def stop(self) -> None:
        """End an open stream."""
        self._stopped.set()

    def close(self) -> None:
        """Play nothing more."""
        self._closed = True
        self._stopped.set()

    def _begin(self) -> None:
        if self._closed:
            raise NotConnectedError(self.name, f"{self._folder} was closed. Open it again")
        self._stopped.clear()
        self._last = None
        if self._position < len(self._rows):
            self._begun = self._clock.now() - self._rows[self._position].time

    @contextmanager
    def _exclusive(self) -> Iterator[None]:
        with alone(self.name, self._acquiring):
            yield
