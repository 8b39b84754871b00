"""Laser and claw on a relay board.

No such board watches over who commands it: a relay stays as it was told when the cable to it is cut while the board has
its supply. The laser's interlock has therefore four parts: one owner at a time; off when its context is left for
whatever reason; off on `stop()` and `close()`; and a small process that writes the off command should this one die.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.clock import Clock
from drivers.errors import InterlockError, NotConnectedError, in_the_end
from drivers.interfaces import Identity
from drivers.last_words import LastWords
from drivers.relay.boards import NumatoBoard, RelayWiring
from drivers.switches import ConfirmedClaw


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
        """See `RelayWiring.ping`."""
        return self._board.ping()


class BoardLaser(_OnBoard):
    """A line laser on a relay of `board`, on while the relay is on.

    A relay that cannot be read back is switched off on connecting, unless with `control=False` the board is only looked
    at: then nothing is sent but questions.
    """

    def __init__(self, board: RelayWiring, relay: int, *, control: bool = True) -> None:
        super().__init__(board, relay)
        self._board = board
        self._control = control
        self._closed = False
        self._owner = threading.Lock()
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
        if not self._owner.acquire(blocking=False):
            raise InterlockError(self.name, "is already lit by another owner. Wait until that one has finished")
        try:
            if self._board.reads_back and self._board.shows(self._relay):
                raise InterlockError(
                    self.name, f"relay {self._relay} is already on and not ours. Switch it off with stop() first"
                )
            self._off_after_death()
            with in_the_end(self._off):
                self._board.switch(self._relay, True)
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
        self._require_control()
        self._board.switch(self._relay, False)

    def close(self) -> None:
        """Laser off, unless it is only looked at, then release the board."""
        if self._closed:
            return
        self._closed = True
        try:
            if self._control:
                self._board.switch(self._relay, False)
        finally:
            self._goodbye()
            self._board.port.close()

    def _off(self) -> None:
        """Off at the end of a context; `close` has done that already."""
        if not self._closed:
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
