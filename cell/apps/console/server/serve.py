"""The server's own process: what browsers talk to, beside the program that has the cell. Run as a module by it.

It ends when that program does. It has no device and no way to one but the pipes.
"""

import asyncio
import itertools
import json
import logging
import os
import queue
import resource
import signal
import socket
import struct
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from cell.apps.console.host import link
from cell.apps.console.server.access import Access
from cell.apps.console.server.application import Application
from cell.apps.console.server.pages import MOST_BYTES, Pages
from cell.apps.console.view.archive import Archive

JPEG = (cv2.IMWRITE_JPEG_QUALITY, 75)
ANSWER_S, STOP_S = 60.0, 15.0
LASTS_S = 0.1
"""After this a stop that is not confirmed yet holds up the next one no longer."""
IDLE_S = 4.0
"""Wall seconds in which a connection has to say what it wants."""
PING_S = 2.0
"""Wall seconds between two questions whether a page is there, and that it has for each: one that is lost lets go."""
MOST_FILES = 2048
WAITING = 256
BUSY, SILENT = 429, 504
MOST_UNSENT = 64
"""Messages that wait for the cell's program; more are refused."""


class Patient(H11Protocol):
    """Closes a connection that says nothing, so that those who open many and wait keep nobody out."""

    def connection_made(self, transport: Any) -> None:
        """See `asyncio.Protocol`."""
        super().connection_made(transport)
        self.loop.call_later(IDLE_S, self._check_idle, None)

    def _check_idle(self, before: object) -> None:
        """Every `IDLE_S`: has anything been asked for since `before`, or is it still being answered?"""
        # A live link has another protocol by now, which looks after itself.
        if self.transport.get_protocol() is not self or self.transport.is_closing():
            return
        # Set with the first request; to its type it is there from the beginning.
        cycle: Any = self.cycle
        answered = cycle is None or cycle.response_complete
        if answered and cycle is before:
            self.transport.close()
        else:
            self.loop.call_later(IDLE_S, self._check_idle, cycle)


class Server:
    """The two pipes, and the event loop between them and the pages."""

    def __init__(self, pipe: Connection, stops: Connection, setup: link.ServerSetup) -> None:
        self._pipe, self._stops, self._setup = pipe, stops, setup
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[link.Answer]] = {}
        self._unsent: queue.SimpleQueue[object] = queue.SimpleQueue()
        self.access = Access(setup.hosts, setup.port, secure=setup.cert is not None, lasting=setup.lasting)
        self.pages = Pages(self._notify, self._begin_stop)
        self._stopping: dict[int, tuple[float, asyncio.Future[str | None]]] = {}
        self._next: asyncio.Future[str | None] | None = None

    async def run(self) -> None:
        """Until the program at the other end is gone."""
        self._loop = asyncio.get_running_loop()
        application = Application(
            self.access, self.pages,
            Archive(Path(self._setup.runs), Path(self._setup.calibrations), self._setup.max_age_s),
            cell=self._setup.cell, do=self._do, stop=self._stop,
            of_job=lambda job: self._ask(lambda number: link.AskCell(number, job)),
            entered=self._renew if self._setup.lasting is None else lambda: None,
        )  # fmt: skip
        config = uvicorn.Config(
            application.asgi(), http=Patient, ws="websockets-sansio", lifespan="off", loop="asyncio",
            log_config=None, access_log=False, server_header=False, date_header=False, proxy_headers=False,
            ws_max_size=MOST_BYTES, ws_max_queue=8, ws_ping_interval=PING_S, ws_ping_timeout=PING_S,
            ws_per_message_deflate=False, h11_max_incomplete_event_size=16384,
            timeout_keep_alive=10, timeout_graceful_shutdown=1,
            ssl_certfile=self._setup.cert, ssl_keyfile=self._setup.key, backlog=WAITING,
        )  # fmt: skip
        server = uvicorn.Server(config)
        for work in (self._hear, self._hear_stops, self._send):
            threading.Thread(target=work, name=work.__name__, daemon=True).start()
        # Who comes as soon as the link is known waits a moment, and is not turned away.
        listening = socket.socket(fileno=self._setup.fd)
        listening.listen(WAITING)
        self._renew()
        await server.serve(sockets=[listening])

    def _renew(self) -> None:
        """A new link for the next page."""
        self._notify(link.Ready(None if self._setup.lasting is not None else self.access.link()))

    def _notify(self, message: object) -> bool:
        """Never waits; False when too much waits already. What ends something is sent in any case."""
        if self._unsent.qsize() >= MOST_UNSENT and not isinstance(message, link.Left | link.Ready):
            return False
        self._unsent.put(message)
        return True

    def _send(self) -> None:
        with suppress(OSError):
            while True:
                self._pipe.send(self._unsent.get())

    async def _ask(self, make: Callable[[int], object]) -> tuple[int, Mapping[str, object]]:
        number = next(self._numbers)
        answer: asyncio.Future[link.Answer] = self._loop.create_future()
        if not self._notify(make(number)):
            return BUSY, {"ok": False, "error": "busy", "text": "too much is being asked at once; wait a moment"}
        self._waiting[number] = answer
        try:
            told = await asyncio.wait_for(answer, ANSWER_S)
        except TimeoutError:
            return SILENT, {"ok": False, "error": "DeadlineError", "text": f"no answer within {ANSWER_S:.0f} s"}
        finally:
            self._waiting.pop(number, None)
        return told.status, told.words

    async def _do(self, client: str, words: Mapping[str, object]) -> tuple[int, Mapping[str, object]]:
        return await self._ask(lambda number: link.Do(number, client, words))

    async def _stop(self) -> str | None:
        """On its own pipe, whatever else is under way; what could not be confirmed."""
        try:
            return await asyncio.wait_for(asyncio.shield(self._begin_stop()), STOP_S)
        except TimeoutError:
            return f"the stop was not confirmed within {STOP_S:.0f} s: use the emergency stop"

    def _begin_stop(self) -> asyncio.Future[str | None]:
        """The stop that answers one who asks now. All who ask while one has just begun have the next one in common. One
        that lasts, because a device does not confirm it, holds up no other: two are under way at most."""
        if self._next is None:
            self._next = self._loop.create_future()
            asked = self._next
            self._send_next()
            return asked
        return self._next

    def _send_next(self) -> None:
        """Send the stop that is asked for, once the one before it is done or lasts."""
        if self._next is None:
            return
        ages = [self._loop.time() - begun for begun, _ in self._stopping.values()]
        if not ages or (len(ages) < link.MOST_STOPS and min(ages) >= LASTS_S):
            number = next(self._numbers)
            self._stopping[number] = self._loop.time(), self._next
            self._next = None
            self._stops.send(link.StopCell(number))
        elif len(ages) < link.MOST_STOPS:
            self._loop.call_later(max(0.01, LASTS_S - min(ages)), self._send_next)

    def _stopped(self, message: link.Stopped) -> None:
        _, asked = self._stopping.pop(message.number)
        if not asked.done():
            asked.set_result(message.trouble)
        self._send_next()

    def _hear_stops(self) -> None:
        _until_the_end(self._stops, lambda message: self._loop.call_soon_threadsafe(self._stopped, message))

    def _hear(self) -> None:
        _until_the_end(self._pipe, self._take)

    def _take(self, message: object) -> None:
        """In the pipe's thread: compressing is done here, beside the event loop."""
        match message:
            case link.ShownPicture(header, image):
                done, jpeg = cv2.imencode(".jpg", image, JPEG)
                if done:
                    message = header["camera"], packed(header, np.asarray(jpeg).tobytes())
            case link.CloudPart(header, payload):
                message = header, packed(header, payload)
        self._loop.call_soon_threadsafe(self._pass_on, message)

    def _pass_on(self, message: object) -> None:
        match message:
            case link.Show(state):
                for mailbox in self.pages.mailboxes:
                    mailbox.show("state", state)
            case link.Happened(event):
                for mailbox in self.pages.mailboxes:
                    mailbox.event(event)
            case link.Say(client, words):
                self.pages.say(client, words)
            case link.Answer():
                future = self._waiting.get(message.number)
                if future is not None and not future.done():
                    future.set_result(message)
            case (str() as camera, bytes() as picture):
                self.pages.picture(camera, picture)
            case (dict() as header, bytes() as part):
                self.pages.cloud(header, part)


def packed(header: Mapping[str, object], payload: bytes) -> bytes:
    """A binary message: length of the header, the header, the payload (docs/reference/console.md)."""
    words = json.dumps(header).encode()
    return struct.pack("<I", len(words)) + words + payload


def _until_the_end(pipe: Connection, take: Callable[[Any], object]) -> None:
    try:
        while True:
            message = pipe.recv()
            try:
                take(message)
            except Exception:
                logging.getLogger(__name__).exception("a message of the cell: %s", type(message).__name__)
    except (EOFError, OSError):
        # The program is gone, and the cell with it.
        os._exit(0)


def main(pipe: int, stops: int) -> None:
    """Serve on two inherited pipes."""
    for number in (signal.SIGINT, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST_FILES if hard == resource.RLIM_INFINITY else min(MOST_FILES, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, most), hard))
    # Pages that are open when it ends are no error.
    logging.getLogger("uvicorn.error").addFilter(lambda record: "graceful shutdown" not in str(record.msg))
    cv2.setNumThreads(1)
    ends = Connection(pipe), Connection(stops)
    setup: link.ServerSetup = ends[0].recv()
    asyncio.run(Server(*ends, setup).run())


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
