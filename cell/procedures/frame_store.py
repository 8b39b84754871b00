"""Keeps the frames of a run as PNG files, written by a thread of its own so that no sweep waits for the disk."""

import hashlib
import queue
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.base.storage import sync_files
from drivers.errors import CellError
from drivers.interfaces import Frame, Vector

CAPACITY = 64
"""Frames that may wait to be written; with more, the sweep is held up rather than a frame lost."""


WRITE_TIMEOUT_S = 5.0
SETTLE_S = 60.0
"""Wall seconds that a full queue has to reach the disk."""
RECENT = 12
"""Names of a step's frames that are remembered, the newest."""


class FrameFile:
    """A frame's file: its `name`, and its bytes once they are there."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._done = threading.Event()
        self._png: bytes | None = None

    def give(self, png: bytes | None) -> None:
        """These are its bytes; None when there are none."""
        self._png = png
        self._done.set()

    def png(self, timeout: float) -> bytes | None:
        """Its bytes, or None when there are none after so many seconds on the wall."""
        self._done.wait(timeout)
        return self._png


Cut = Callable[[], NDArray[np.uint8]]
"""What makes of a picture the one that is kept: black where nobody will look."""

Listener = Callable[[str, Frame, FrameFile], None]
"""Told of each frame that is kept: of what, the frame, and its file."""


class FrameStore:
    """Writes frames into `folder`, made with the first of them, as `<what>-<frame id>.png`, lossless, or none.

    `recent` names the newest frames of the present step, `last` is the very last with its kind: what a run that ends
    there was looking at. `found` is where the board was seen last: the frame, and its points (n, 2) in px.
    """

    def __init__(self, folder: Path, listener: Listener | None = None, *, kept: bool = True) -> None:
        self.begin()
        self.found: tuple[Frame, Vector] | None = None
        self._folder = folder
        self._listener = listener
        self._kept = kept
        self._waiting: queue.Queue[tuple[FrameFile, Frame, Cut | None] | threading.Event | None] = queue.Queue(CAPACITY)
        self._failure: str | None = None
        self._digests: dict[str, str] = {}
        self._thread = threading.Thread(target=self._write, name="frame store", daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """A step begins: what the steps before it looked at is no longer recent."""
        self.recent: deque[str] = deque(maxlen=RECENT)
        self.last: tuple[str, Frame] | None = None

    def keep(self, what: str, frame: Frame, cut: Cut | None = None) -> None:
        """Queue a frame, or what `cut` makes of it; raises `CellError` when an earlier one could not be written."""
        if self._failure is not None:
            raise CellError(f"frames cannot be kept: {self._failure}; make room in {self._folder}")
        self.last = what, frame
        if not self._kept:
            return
        name = f"{what}-{frame.frame_id:06d}.png"
        self.recent.append(name)
        picture = FrameFile(name)
        if self._listener is not None:
            self._listener(what, frame, picture)
        try:
            self._waiting.put((picture, frame, cut), timeout=WRITE_TIMEOUT_S)
        except queue.Full:
            self._failure = f"the disk took no frame for {WRITE_TIMEOUT_S:.0f} s"
            raise CellError(f"frames cannot be kept: {self._failure}; look at {self._folder}") from None

    def settle(self) -> dict[str, str]:
        """Wait until all frames so far are on the disk: the SHA-256 of each file by its name. Raises `CellError` when
        one could not be written."""
        written = threading.Event()
        try:
            self._waiting.put(written, timeout=WRITE_TIMEOUT_S)
            if not written.wait(SETTLE_S):
                self._failure = f"frames were still to be written after {SETTLE_S:.0f} s"
            elif self._folder.is_dir():
                sync_files(self._folder)
        except (queue.Full, OSError) as error:
            self._failure = str(error) or f"the disk took no frame for {WRITE_TIMEOUT_S:.0f} s"
        if self._failure is not None:
            raise CellError(f"frames cannot be kept: {self._failure}; make room in {self._folder}")
        return dict(self._digests)

    @property
    def failure(self) -> str | None:
        """Why frames are missing, or None."""
        return self._failure

    def _write(self) -> None:
        while (item := self._waiting.get()) is not None:
            if isinstance(item, threading.Event):
                item.set()
                continue
            picture, frame, cut = item
            path, data = self._folder / picture.name, None
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                made, png = cv2.imencode(".png", frame.image if cut is None else cut())
                if made:
                    data = np.asarray(png).tobytes()
                    path.write_bytes(data)
                    self._digests[picture.name] = hashlib.sha256(data).hexdigest()
                else:
                    self._failure = f"{path} could not be written"
            except Exception as error:  # the writer must go on emptying the queue
                self._failure = f"{path}: {error}"
            picture.give(data)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._waiting.put(None, timeout=WRITE_TIMEOUT_S)
        except queue.Full:
            self._failure = f"the disk took no frame for {WRITE_TIMEOUT_S:.0f} s"
            return
        self._thread.join(2 * WRITE_TIMEOUT_S)
        if self._thread.is_alive():
            self._failure = f"frames were still to be written after {2 * WRITE_TIMEOUT_S:.0f} s"
