"""Laser and claw on a relay board, of one of two families: one can be asked for its relays, the other only listens.

No such board watches over who commands it: a relay stays as it was told when the cable to it is cut while the board has
its supply. The laser's interlock has therefore four parts: one owner at a time; off when its context is left for
whatever reason; off on `stop()` and `close()`; and a small process that writes the off command should this one die.

Source: docs/how-to/other-makes.md, section 2.
"""

import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar

import serial

from drivers.clock import Clock
from drivers.errors import (
    UNTOLD,
    Aborted,
    ConfigError,
    DeadlineError,
    DeviceFault,
    InterlockError,
    NotConnectedError,
    in_the_end,
)
from drivers.interfaces import Identity, LinkStatistics
from drivers.last_words import LastWords, descriptor_of
from drivers.ports import FAILURES, open_port
from drivers.switches import ConfirmedClaw

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
        self.port: serial.Serial | None = None
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
    Raises `NotConnectedError`, and `ConfigError` when another device has the same port open at another speed."""

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

    def ask(
        self, request: bytes, end: bytes, decode: Callable[[bytes], Answer], wanted: Callable[[], None] = lambda: None
    ) -> tuple[Answer, float]:
        """Send `request`, read up to `end`: the decoded reply, and the round trip in wall seconds. What is sent has to
        mean the same when it is heard twice: a lost or damaged reply is asked for again."""
        failure = BadRelayReply("nothing came")
        for attempt in range(_ATTEMPTS):
            if attempt:
                self.statistics.count("retries")
            with self._held() as port:
                wanted()
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

    def tell(self, words: bytes, wanted: Callable[[], None] = lambda: None) -> None:
        """Send what nobody answers."""
        with self._held() as port:
            wanted()
            port.write(words)
            port.flush()
            self.statistics.traffic.sent(words)

    def touch(self) -> None:
        """See that the port is still there, without sending a byte."""
        with self._held():
            pass

    @contextmanager
    def _held(self) -> Iterator[serial.Serial]:
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


def _drain(port: serial.Serial) -> None:
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


_DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUV"
"""Relays and inputs as a Numato board counts them: those from 10 on by letters."""
_PROMPT = b">"


class RelayWiring(Protocol):
    """One board, as the device behind `port` uses it. Relays and inputs are counted as the board counts them."""

    port: RelayPort

    @property
    def reads_back(self) -> bool:
        """Whether `shows` is what the board says; else it is what was last sent."""

    def identity(self) -> Identity:
        """Ask the board who it is."""

    def ping(self) -> float:
        """One harmless round trip in wall seconds; of a board that never answers, that its port is there: 0 s."""

    def switch(self, relay: int, on: bool, wanted: Callable[[], None] = lambda: None) -> None:
        """Set a relay, and see that it took it where the board can be asked. `wanted` raises, before each attempt,
        where it is not any more."""

    def shows(self, relay: int) -> bool:
        """What a relay shows; `DeviceFault` (KIND.unknown) where nobody can know."""

    def off_words(self, relay: int) -> list[bytes]:
        """What a process that outlives this one writes to switch the relay off."""


class NumatoBoard:
    """A board of Numato Lab with an ASCII command line: it echoes each command, answers, and ends with a prompt."""

    reads_back = True

    def __init__(self, port: RelayPort) -> None:
        self.port = port

    def identity(self) -> Identity:
        """Its firmware's version and the id of eight characters that can be written into it."""
        version, number = self._ask("ver"), self._ask("id get")
        return Identity("Numato relay module", number or UNTOLD, version or UNTOLD, self.port.url)

    def ping(self) -> float:
        """Ask for its version."""
        return self.port.ask(b"ver\r", _PROMPT, lambda data: _answer(data, "ver"))[1]

    def switch(self, relay: int, on: bool, wanted: Callable[[], None] = lambda: None) -> None:
        """Set a relay and read it back; `DeviceFault` (KIND.relay) when it shows the other."""
        self._ask(f"relay {'on' if on else 'off'} {_DIGITS[relay]}", wanted)
        if self.shows(relay) != on:
            raise DeviceFault(
                self.port.name,
                f"{self.port.kind}.relay",
                f"relay {relay} of {self.port.url} shows {'off' if on else 'on'} after it was switched "
                f"{'on' if on else 'off'}",
                recoverable=False,
                hint="See that the board has this relay and its supply, and that no other program switches it.",
            )

    def shows(self, relay: int) -> bool:
        """Ask for a relay's state."""
        return self._level(f"relay read {_DIGITS[relay]}")

    def input(self, number: int) -> bool:
        """Ask for an input: whether it is high. The board makes that pin an input with it."""
        return self._level(f"gpio read {_DIGITS[number]}")

    def off_words(self, relay: int) -> list[bytes]:
        """An end of whatever the owner had begun, then the command."""
        return [b"\r", f"relay off {_DIGITS[relay]}\r".encode()]

    def _ask(self, command: str, wanted: Callable[[], None] = lambda: None) -> str:
        return self.port.ask(f"{command}\r".encode(), _PROMPT, lambda data: _answer(data, command), wanted)[0]

    def _level(self, command: str) -> bool:
        def level(data: bytes) -> bool:
            told = _answer(data, command).lower()
            if told in ("on", "1"):
                return True
            if told in ("off", "0"):
                return False
            raise BadRelayReply(f"{told!r} is neither on nor off")

        return self.port.ask(f"{command}\r".encode(), _PROMPT, level)[0]


def _answer(data: bytes, command: str) -> str:
    """The text between the echo of `command` and the prompt."""
    lines = [line.strip() for line in re.split(r"[\r\n]+", data.decode("ascii", "replace").rstrip(">"))]
    told = [line for line in lines if line]
    if not told or told[0] != command:
        raise BadRelayReply(f"{data!r} came, which does not repeat the command")
    return " ".join(told[1:])


class LcusBoard:
    """A board of the LCUS kind (CH340 and a microcontroller): four bytes set a relay, and nothing ever comes back.

    What is known of a relay is what was last sent to it over this very port; as soon as the port was opened anew, that
    is nothing. With `control` each relay that is used is switched off once on connecting, so that it is known.
    """

    reads_back = False

    def __init__(self, port: RelayPort) -> None:
        self.port = port
        self._sent: dict[int, tuple[int, bool]] = {}

    def identity(self) -> Identity:
        """What the make says of itself: the board tells nothing."""
        self.port.touch()
        return Identity("LCUS relay board, cannot be asked", UNTOLD, UNTOLD, self.port.url)

    def ping(self) -> float:
        """See that the port is there; the board itself answers nothing."""
        self.port.touch()
        return 0.0

    def switch(self, relay: int, on: bool, wanted: Callable[[], None] = lambda: None) -> None:
        """Set a relay. Off is said twice: nobody would notice that a byte was lost."""
        self._sent.pop(relay, None)
        words = _lcus(relay, on)
        self.port.tell(words if on else words + words, wanted)
        self._sent[relay] = self.port.opened, on

    def shows(self, relay: int) -> bool:
        """What was last sent; `DeviceFault` (KIND.unknown) when that is nothing, or was over a link that was lost."""
        self.port.touch()
        opened, on = self._sent.get(relay, (0, False))
        if opened != self.port.opened:
            raise DeviceFault(
                self.port.name,
                f"{self.port.kind}.unknown",
                f"nobody knows what relay {relay} of {self.port.url} shows: such a board cannot be asked, and nothing "
                "was sent to it since its port was opened",
                recoverable=False,
                hint="Switch it off (stop() does), or look at the lamp on the board.",
            )
        return on

    def off_words(self, relay: int) -> list[bytes]:
        """Twice, as `switch` does."""
        return [_lcus(relay, False)] * 2


def _lcus(relay: int, on: bool) -> bytes:
    """Start, number of the relay from 1, what to do, and the sum of the three."""
    head = bytes([0xA0, relay, int(on)])
    return head + bytes([sum(head) & 0xFF])


def open_board(name: str, kind: str, make: str, url: str, *, baud: int) -> NumatoBoard | LcusBoard:
    """The board of that make ("numato", "lcus") at `url`, as the device `name` of that kind ("laser", "claw") uses it.
    Raises `NotConnectedError` when there is no port, `DeadlineError` when a board that can be asked does not answer."""
    return (
        open_numato(name, kind, url, baud=baud)
        if make == "numato"
        else LcusBoard(RelayPort(name, kind, url, baud=baud))
    )


def open_numato(name: str, kind: str, url: str, *, baud: int) -> NumatoBoard:
    """Open the port and see that the board answers there."""
    board = NumatoBoard(RelayPort(name, kind, url, baud=baud))
    try:
        board.ping()
    except BaseException:
        board.port.close()
        raise
    return board


class _OnBoard:
    """What both share: a relay of a board, which is the wire."""

    def __init__(self, board: RelayWiring, relay: int) -> None:
        self.name = board.port.name
        self.statistics = board.port.statistics
        self._relay = relay

    _board: RelayWiring

    def identity(self) -> Identity:
        """The board's identity, with the relay in the address."""
        who = self._board.identity()
        return Identity(who.model, who.serial, who.firmware, f"{who.address} relay {self._relay}")

    def ping(self) -> float:
        return self._board.ping()


class BoardLaser(_OnBoard):
    """A line laser on a relay of `board`, on while the relay is on. A relay that cannot be read back is switched off on
    connecting, unless with `control=False` the board is only looked at: then nothing is sent but questions."""

    def __init__(self, board: RelayWiring, relay: int, *, control: bool = True) -> None:
        super().__init__(board, relay)
        self._board = board
        self._control = control
        self._closed = self._released = False
        self._stops = 0
        self._owner = threading.Lock()
        # Lighting it and closing it: whatever was lit before the end goes off in it, and nothing is lit after it.
        self._ending = threading.Lock()
        self._last_words: LastWords | None = None
        self._last_words_for = 0
        if control and not board.reads_back:
            try:
                board.switch(relay, False)
            except BaseException:
                board.port.close()
                raise

    @contextmanager
    def lit(self) -> Iterator[None]:
        """On inside the context, off after it, whatever happens inside.

        Raises `InterlockError`, with nothing switched, when the laser is lit already: by another context of this
        program or, where the board tells, by anything else that set the relay.
        """
        self._require_control()
        stops = self._stops

        def wanted() -> None:
            if self._stops != stops:
                raise Aborted(f"{self.name}: stopped before it was lit")

        if not self._owner.acquire(blocking=False):
            raise InterlockError(self.name, "is already lit by another owner. Wait until that one has finished")
        try:
            if self._board.reads_back and self._board.shows(self._relay):
                raise InterlockError(
                    self.name, f"relay {self._relay} is already on and not ours. Switch it off with stop() first"
                )
            with in_the_end(self._off):
                with self._ending:
                    self._require_control()
                    self._off_after_death()
                    self._board.switch(self._relay, True, wanted)
                yield
        finally:
            self._owner.release()

    @property
    def is_on(self) -> bool:
        """What the board says of its relay, asked now; of one that cannot be asked what was last sent, see
        `how_known`. `DeviceFault` (laser.unknown) where nobody can know."""
        return self._board.shows(self._relay)

    @property
    def how_known(self) -> str:
        """What a board that cannot be asked leaves open; "" for one that can."""
        return "" if self._board.reads_back else "as last commanded: this board cannot be asked what its relay shows"

    def stop(self) -> None:
        """Laser off now, whoever has it. After a lost link the port is opened again for it."""
        if self._released or not self._control:
            self._require_control()
        self._stops += 1
        self._board.switch(self._relay, False)

    def close(self) -> None:
        """Laser off, unless it is only looked at, then release the board. Where it cannot be switched off the port and
        the helper stay: the next call, the end of `lit` or the end of this program tries again."""
        with self._ending:
            if self._released:
                return
            self._closed = True
            self._stops += 1
            if self._control:
                self._board.switch(self._relay, False)
            self._released = True
            self._goodbye()
            self._board.port.close()

    def _off(self) -> None:
        """Off at the end of a context; `close` has done that already."""
        if not self._released:
            self._board.switch(self._relay, False)

    def _goodbye(self) -> None:
        if self._last_words is not None:
            self._last_words.close()
            self._last_words = None

    def _require_control(self) -> None:
        if self._closed:
            raise NotConnectedError(self.name, "was closed. Open it again")
        if not self._control:
            raise InterlockError(self.name, "was opened to be looked at only; nothing was sent. Open it for control")

    def _off_after_death(self) -> None:
        """From the first light on, and anew for a port that was opened anew."""
        port = self._board.port
        if self._last_words_for == port.opened or (descriptor := port.descriptor) is None:
            return
        # The helper holds the port as well: it has to let go before that can be opened anew.
        port.at_loss(self._goodbye)
        self._last_words = LastWords(self.name, descriptor, self._board.off_words(self._relay))
        self._last_words_for = port.opened


class BoardClaw(_OnBoard, ConfirmedClaw):
    """A gripper on a relay of `board` (on = closed), confirmed by its input `feedback`, which is high (or, with
    `active_high=False`, low) while a part is held.

    A lost link changes nothing: the relay stays as it is, and so does the claw.
    """

    def __init__(
        self, board: NumatoBoard, relay: int, feedback: int, *, active_high: bool, clock: Clock, control: bool = True
    ) -> None:
        super().__init__(board, relay)
        self._board: NumatoBoard = board
        self._feedback = feedback
        self._active_high = active_high
        self._shown_by = f"input {feedback} of the board"
        self._clock = clock
        self._control = control

    @property
    def holding(self) -> bool:
        """What the feedback input shows, asked now."""
        return self._board.input(self._feedback) == self._active_high

    def stop(self) -> None:
        """Nothing to stop: the claw stays as it is, because opening would drop the part."""

    def close(self) -> None:
        """Leave the claw as it is; release the board."""
        self._board.port.close()

    def _close(self, closed: bool) -> None:
        if not self._control:
            raise InterlockError(self.name, "was opened to be looked at only; nothing was sent. Open it for control")
        self._board.switch(self._relay, closed)
