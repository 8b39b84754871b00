"""The serial port of a relay board: one exchange at a time, shared by the devices whose relays are on the same board.

A port that failed is opened again by the next command, so that a cable that is plugged in again is enough.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from drivers.errors import ConfigError, DeadlineError, DeviceFault, NotConnectedError
from drivers.interfaces import LinkStatistics
from drivers.last_words import descriptor_of
from drivers.serial_port import FAILURES, open_port

REPLY_TIMEOUT_S = 0.3
"""Wall seconds for a reply: boards on USB answer within a few ms, a loaded machine may add tens."""
_QUIET_S = 0.03
_ATTEMPTS = 2
_LONGEST = 256
"""Bytes after which something that does not end is no reply."""

Answer = TypeVar("Answer")


class BadRelayReply(Exception):
    """What came is no reply to what was asked."""


class _Line:
    """A port that is open, or was and is opened again; `opened` counts how often."""

    def __init__(self, baud: int) -> None:
        self.baud = baud
        self.lock = threading.Lock()
        self.port: Any = None
        self.opened = 0
        self.users = 0
        self.at_loss: list[Callable[[], None]] = []

    def drop(self) -> None:
        while self.at_loss:
            self.at_loss.pop()()
        if self.port is not None:
            self.port.close()
        self.port = None


_lines: dict[str, _Line] = {}
_opening = threading.Lock()


class RelayPort:
    """The port at `url` as one device uses it: errors carry its `name`, `kind` ("laser", "claw") begins their codes.

    Raises `NotConnectedError`, and `ConfigError` when another device has the same port open at another speed.
    """

    def __init__(self, name: str, kind: str, url: str, *, baud: int) -> None:
        self.name = name
        self.kind = kind
        self.url = url
        self.statistics = LinkStatistics()
        self._key = os.path.realpath(url) if url.startswith("/") else url
        self._closed = False
        with _opening:
            self._line = _lines.setdefault(self._key, _Line(baud))
            if self._line.baud != baud:
                raise ConfigError(
                    f"{name}: {url} is open at {self._line.baud} baud for another device of the same board, not at "
                    f"{baud}; write one baud for both"
                )
            self._line.users += 1
        try:
            with self._held():
                pass
        except BaseException:
            self.close()
            raise

    @property
    def opened(self) -> int:
        """How often the port was opened: what was known of the board before the newest time may not hold any more."""
        return self._line.opened

    @property
    def descriptor(self) -> int | None:
        """The port's file descriptor; None where there is none."""
        return descriptor_of(self._line.port)

    def at_loss(self, action: Callable[[], None]) -> None:
        """Do `action` before the port that is open now is closed, because it failed or is not needed any more."""
        self._line.at_loss.append(action)

    def close(self) -> None:
        """The device has done with it; the last one closes the port. Idempotent."""
        with _opening, self._line.lock:
            if self._closed:
                return
            self._closed = True
            self._line.users -= 1
            if self._line.users == 0:
                self._line.drop()
                _lines.pop(self._key, None)

    def ask(self, request: bytes, end: bytes, decode: Callable[[bytes], Answer]) -> tuple[Answer, float]:
        """Send `request`, read up to `end`: the decoded reply, and the round trip in wall seconds.

        What is sent has to mean the same when it is heard twice: a lost or damaged reply is asked for again.
        """
        failure = BadRelayReply("nothing came")
        for attempt in range(_ATTEMPTS):
            if attempt:
                self.statistics.count("retries")
            with self._held() as port:
                before = time.monotonic()
                port.write(request)
                self.statistics.traffic.sent(request)
                data = bytes(port.read_until(end, _LONGEST))
                took = time.monotonic() - before
            self.statistics.traffic.received(data)
            try:
                if not data.endswith(end):
                    self.statistics.count("timeouts")
                    raise BadRelayReply(f"{data!r} came")
                answer = decode(data)
            except BadRelayReply as problem:
                failure = problem
                continue
            self.statistics.add_round_trip(took)
            return answer, took
        raise DeadlineError(
            self.name,
            f"no valid reply to {request!r} within {REPLY_TIMEOUT_S} s, {_ATTEMPTS} attempts ({failure}). Check that "
            f"the board at {self.url} is of this make, has its supply, and that its baud is {self._line.baud}",
        ) from failure

    def tell(self, words: bytes) -> None:
        """Send what nobody answers."""
        with self._held() as port:
            port.write(words)
            port.flush()
            self.statistics.traffic.sent(words)

    def touch(self) -> None:
        """See that the port is still there, without sending a byte."""
        with self._held():
            pass

    @contextmanager
    def _held(self) -> Iterator[Any]:
        """The port, for this thread alone and with nothing late in it; what fails inside is told as a lost link."""
        line = self._line
        with line.lock:
            if self._closed:
                raise NotConnectedError(self.name, "was closed. Open it again")
            if line.port is None:
                line.port = open_port(self.name, self.url, baud=line.baud, timeout=REPLY_TIMEOUT_S)
                line.opened += 1
            try:
                _drain(line.port)
                yield line.port
            except FAILURES as error:
                self.statistics.count("link_lost")
                line.drop()
                raise DeviceFault(
                    self.name,
                    f"{self.kind}.link_lost",
                    f"the port {self.url} failed: {error}; what its relay shows now is not known",
                    recoverable=False,
                    hint="Look at the board itself and plug its cable in again; the next command opens the port anew.",
                ) from error


def _drain(port: Any) -> None:
    """Throw away what came too late for the command that asked for it."""
    if not port.in_waiting:
        return
    port.timeout = _QUIET_S
    try:
        until = time.monotonic() + REPLY_TIMEOUT_S
        while port.read(_LONGEST) and time.monotonic() < until:
            pass
    finally:
        port.timeout = REPLY_TIMEOUT_S
