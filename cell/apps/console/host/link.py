"""The pipes between the program that has the cell and its server: what passes, pickled, and the program's end of them.

It starts the server, hears it, and tells it only as fast as it listens. The stop comes on a pipe of its own, on which
nothing else can be under way, to threads that do nothing else; another one waits for the server's end.
"""

import logging
import os
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CellError

START_S = 30.0
END_S = 3.0
MOST_EVENTS, MOST_CLOUDS, MOST_SAID = 200, 64, 200

log = logging.getLogger(__name__)


MOST_STOPS = 2
"""So many are carried out at a time: one that lasts, and one more."""


class ServerSetup(NamedTuple):
    """How the server works; the first that it is told. `fd` is the socket that is bound for it already.

    `lasting` is the token of a file; `cert` and `key` are files for TLS. `cell` is what `/api/cell` answers.
    `max_age_s` is how old a calibration in the folder `calibrations` may become.
    """

    fd: int
    port: int
    hosts: tuple[str, ...]
    lasting: str | None
    cert: str | None
    key: str | None
    runs: str
    cell: Mapping[str, object]
    calibrations: str
    max_age_s: float


# --- server to cell ---


class Ready(NamedTuple):
    """The server answers; `token` opens it once."""

    token: str | None


class Joined(NamedTuple):
    """A page was opened."""

    client: str


class Left(NamedTuple):
    """A page is gone."""

    client: str


class Do(NamedTuple):
    """A page asks for something; answered by `Answer` of the same number."""

    number: int
    client: str
    words: Mapping[str, object]


class AskCell(NamedTuple):
    """What is `/api/cell` with this job's station? Answered by `Answer`."""

    number: int
    job: str


class Beat(NamedTuple):
    """A button is held; with `end` it is not any more."""

    client: str
    words: Mapping[str, object]
    end: bool = False


# --- cell to server ---


class Answer(NamedTuple):
    """To `Do` or `AskCell`: HTTP status and JSON."""

    number: int
    status: int
    words: Mapping[str, object]


class Say(NamedTuple):
    """To one page."""

    client: str
    words: Mapping[str, object]


class Show(NamedTuple):
    """The state, as JSON; newest only."""

    state: str


class Happened(NamedTuple):
    """Something for every page's list, as JSON."""

    event: str


class ShownPicture(NamedTuple):
    """A grey picture that is to be compressed and shown."""

    header: Mapping[str, Any]
    image: NDArray[np.uint8]


class CloudPart(NamedTuple):
    """An increment of the cloud."""

    header: Mapping[str, object]
    payload: bytes


# --- on the other pipe ---


class StopCell(NamedTuple):
    """Stop the cell; answered by `Stopped` of the same number."""

    number: int


class Stopped(NamedTuple):
    """It was stopped; `trouble` is what could not be confirmed."""

    number: int
    trouble: str | None


# --- the program's end ---


class ServerOutbox:
    """What waits for the server: of what is shown only the newest."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._words: deque[object] = deque()
        self._said: deque[object] = deque(maxlen=MOST_SAID)
        self._events: deque[object] = deque(maxlen=MOST_EVENTS)
        self._clouds: deque[object] = deque(maxlen=MOST_CLOUDS)
        self._newest: dict[str, object] = {}
        self._closed = False

    def put(self, message: object) -> None:
        """Never waits."""
        with self._news:
            match message:
                case Show():
                    self._newest["state"] = message
                case ShownPicture(header, _):
                    self._newest[header["camera"]] = message
                case Happened():
                    self._events.append(message)
                case Say():
                    self._said.append(message)
                case CloudPart():
                    self._clouds.append(message)
                case _:
                    self._words.append(message)
            self._news.notify_all()

    def close(self) -> None:
        """Nothing more is taken out."""
        with self._news:
            self._closed = True
            self._news.notify_all()

    def take(self) -> object | None:
        """The next; waits for it, None once it is closed."""
        with self._news:
            while not self._closed:
                for waiting in (self._words, self._said, self._events, self._clouds):
                    if waiting:
                        return waiting.popleft()
                if self._newest:
                    return self._newest.pop(next(iter(self._newest)))
                self._news.wait()
        return None


class ServerProcess:
    """The server, started for `setup`, whose socket `bound` it gets. `heard` is told its messages, `stop` stops the
    cell and gives what was not confirmed, `gone` is called once when it has ended by itself."""

    def __init__(
        self, setup: Callable[[int], ServerSetup], bound: socket.socket, heard: Callable[[object], None],
        stop: Callable[[], str | None], gone: Callable[[], None],
    ) -> None:  # fmt: skip
        """Start it; `CellError` when it does not answer."""
        self._heard, self._stop, self._gone = heard, stop, gone
        self._outbox = ServerOutbox()
        self._closing = False
        self._ready = threading.Event()
        pairs = socket.socketpair(), socket.socketpair()
        theirs = [pair[1] for pair in pairs]
        fds = [bound.fileno(), *(end.fileno() for end in theirs)]
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join(path or "." for path in sys.path))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "cell.apps.console.server.serve", str(fds[1]), str(fds[2])],
            pass_fds=fds,
            stdin=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,  # a Ctrl-C is for the program that has the cell
        )
        for end in theirs:
            end.close()
        self._pipe, self._stops = (Connection(pair[0].detach()) for pair in pairs)
        self._pipe.send(setup(fds[0]))
        bound.close()
        self._receiving, self._answering = threading.Lock(), threading.Lock()
        for work in (self._hear, *MOST_STOPS * [self._carry_out_stops], self._notify, self._wait_for_end):
            threading.Thread(target=work, name=f"console {work.__name__.strip('_')}", daemon=True).start()
        if not self._ready.wait(START_S):
            self.close()
            raise CellError("the console's server did not start; in the checkout: pip install -e '.[console]'")

    def notify(self, message: object) -> None:
        """To the server, when it listens; never waits."""
        self._outbox.put(message)

    def close(self) -> None:
        """End it; idempotent."""
        self._closing = True
        self._outbox.close()
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(END_S)

    def _notify(self) -> None:
        with suppress(OSError, ValueError):
            while (message := self._outbox.take()) is not None:
                self._pipe.send(message)

    def _hear(self) -> None:
        try:
            while True:
                message = self._pipe.recv()
                if isinstance(message, Ready):
                    self._ready.set()
                try:
                    self._heard(message)
                # One message that goes wrong is no reason to hear no more.
                except Exception:
                    log.exception("a message of the console's server: %s", type(message).__name__)
        except (EOFError, OSError):
            # Without this pipe it is of no use, whatever else it still does.
            if not self._closing:
                self._process.kill()

    def _wait_for_end(self) -> None:
        self._process.wait()
        if not self._closing:
            self._gone()

    def _carry_out_stops(self) -> None:
        """One of `MOST_STOPS` threads: a stop that a device does not confirm holds up no other one."""
        with suppress(EOFError, OSError):
            while True:
                with self._receiving:
                    message: StopCell = self._stops.recv()
                trouble = self._stop()
                with self._answering:
                    self._stops.send(Stopped(message.number, trouble))
