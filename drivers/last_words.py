"""What a device is told when this process dies without a goodbye: said by a small process that outlives it.

A stepper module runs on to its target, and a vehicle drives on for half a second, when nobody talks to them any more.
The helper holds the same port and waits at a pipe. When the pipe ends, the owner is gone: it says the last words and
ends. It also says them while the owner is frozen (stopped, swapped out, in a debugger), and while a motion is
`attended` as soon as nobody attends it. It does nothing else while the owner lives, and nothing after `close()`.
"""

import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

from drivers.errors import CellError, DeviceFault, InterlockError
from drivers.interfaces import ATTENDED_S
from drivers.last_words_child import ALIVE, BEAT, FROZEN_S, GOODBYE, REST

PAUSE_S = 0.02
"""Between two of the last words."""
END_TIMEOUT_S = 2.0

log = logging.getLogger(__name__)


def descriptor_of(port: Any) -> int | None:
    """The file descriptor of a port or a bus; None for one that is no file, which dies with its process."""
    try:
        return int(port.fileno())
    except (AttributeError, OSError, NotImplementedError):
        return None


def attended_by(name: str, helper: "LastWords | None") -> AbstractContextManager[Callable[[], None]]:
    """`LastWords.attended` of the device's helper; `InterlockError` for a port that is no file, which has none."""
    if helper is None:
        raise InterlockError(
            name, "nothing beside this process would stop it when nobody holds the button. Move it by steps"
        )
    return helper.attended()


def frozen_fault(device: str, code: str) -> DeviceFault:
    """What the process beside a frozen one did; the device stands, and may go on once a person or a policy says so."""
    return DeviceFault(
        device,
        code,
        f"this program gave no sign of life for more than {FROZEN_S:g} s, so the process beside it stopped the device",
        recoverable=True,
        hint="The program was suspended, or this computer is too busy or swaps. End other programs, then go on.",
    )


class LastWords:
    """Holds the port with the file `descriptor`; writes each of `words` to it by one system call, in their order."""

    def __init__(self, name: str, descriptor: int, words: Sequence[bytes]) -> None:
        self._name = name
        reader, self._pipe = os.pipe()
        self._told, teller = os.pipe()
        for end in (self._pipe, self._told):
            os.set_blocking(end, False)
        script = Path(__file__).with_name("last_words_child.py")
        command = [sys.executable, "-I", "-S", str(script), *map(str, (reader, teller, descriptor))]
        command += [repr(PAUSE_S), repr(ATTENDED_S)]
        try:
            self._process: subprocess.Popen[bytes] | None = subprocess.Popen(
                [*command, *(word.hex() for word in words)],
                stdin=subprocess.DEVNULL,
                pass_fds=(reader, teller, descriptor),
                start_new_session=True,  # what ends the owner's group must not end the helper
            )
        except OSError as error:
            # The device still works, and its own watchdog, if it has one, still stops it.
            log.warning("%s: nobody will stop it if this process is killed: %s", name, error)
            self._process = None
        finally:
            os.close(reader)
            os.close(teller)
        self._pulse = Pulse(f"{name} pulse", lambda: self._write(ALIVE))

    def require_unspoken(self, code: str) -> None:
        """Raise `DeviceFault` with `code`, once, after the helper has stopped the device of a frozen owner."""
        with suppress(OSError):
            if self._told >= 0 and os.read(self._told, 4096):
                raise frozen_fault(self._name, code)

    @contextmanager
    def attended(self) -> Iterator[Callable[[], None]]:
        """See `drivers.interfaces.Attended`; `InterlockError` when there is no helper."""
        self._say(BEAT)
        try:
            yield lambda: self._say(BEAT)
        finally:
            with suppress(InterlockError):
                self._say(REST)

    def _say(self, word: bytes) -> None:
        try:
            if self._process is None or self._pipe < 0:
                raise OSError("it is not there")
            self._write(word)
        except OSError as error:
            raise InterlockError(
                self._name,
                f"the process that would stop it when nobody holds the button cannot be told: {error}. Move it by "
                "steps, and open the cell again",
            ) from error

    def _write(self, word: bytes) -> None:
        with suppress(BlockingIOError):  # What the helper has not read yet is sign enough.
            os.write(self._pipe, word)

    def close(self) -> None:
        """Say goodbye: the helper ends without a word. Idempotent."""
        if self._pipe < 0:
            return
        self._pulse.close()
        with suppress(OSError):
            self._write(GOODBYE)
        ends, self._pipe, self._told = (self._pipe, self._told), -1, -1
        for end in ends:
            os.close(end)
        if self._process is not None:
            try:
                self._process.wait(END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait(END_TIMEOUT_S)


BEAT_S = 0.05
"""Wall seconds between two beats; `last_words_child.FROZEN_S` allows four of them to be lost."""
_NICENESS = -10


class Pulse:
    """Calls `beat` every `BEAT_S` on a thread of its own until `close`, or until `beat` fails because nobody listens.
    The thread runs before others where the system allows it."""

    def __init__(self, name: str, beat: Callable[[], None]) -> None:
        self._beat = beat
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """No beat comes after this; idempotent."""
        self._closed.set()
        if self._thread is not threading.current_thread():
            self._thread.join(2.0)

    def _run(self) -> None:
        # Linux has a niceness for each thread.
        with suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        with suppress(OSError, CellError):
            while not self._closed.is_set():
                self._beat()
                self._closed.wait(BEAT_S)
