"""Relay boards on a serial line: one with a command line in text, and one that takes four bytes and says nothing.

Written from the makers' descriptions as docs/how-to/other-makes.md, section 2, has them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from sim_backends.peers.server import SerialServer

COUNT = 8
"""Relays, and inputs, of a board."""
VERSION, NUMBER = "00000009", "sim00001"


class RelayBoard:
    """The relays of one board. `wired` are functions that hear of a relay's changes, `lines` tell an input's level."""

    def __init__(
        self,
        wired: Mapping[int, tuple[Callable[[bool], None], Callable[[], bool]]],
        lines: Mapping[int, Callable[[], bool]],
        first: int = 0,
    ) -> None:
        """`wired` gives for a relay how what hangs on it is set, and asked; relays are counted from `first`."""
        self._wired = wired
        self._lines = lines
        self.numbers = range(first, first + COUNT)
        self._free = dict.fromkeys(self.numbers, False)

    def set(self, relay: int, on: bool) -> None:
        """Switch a relay that exists."""
        if relay in self._wired:
            self._wired[relay][0](on)
        else:
            self._free[relay] = on

    def shows(self, relay: int) -> bool:
        """Whether it is on."""
        return self._wired[relay][1]() if relay in self._wired else self._free[relay]

    def level(self, line: int) -> bool:
        """Whether an input is high; a free one is pulled up."""
        return self._lines[line]() if line in self._lines else True


class NumatoPeer(SerialServer):
    """A board with a command line: it repeats what it hears, answers, and prompts."""

    def __init__(self, board: RelayBoard, *, pty: bool = False) -> None:
        self.board = board
        super().__init__("numato", self._hear, pty=pty)

    def _hear(self, data: bytes, write: Callable[[bytes], object]) -> bytes:
        while b"\r" in data:
            line, _, data = data.partition(b"\r")
            command = line.decode("ascii", "replace").strip()
            answer = self._answer(command.split())
            write(f"{command}\n\r{answer}{chr(10) + chr(13) if answer else ''}>".encode())
        return data

    def _answer(self, words: list[str]) -> str:
        match words:
            case ["ver"]:
                return VERSION
            case ["id", "get"]:
                return NUMBER
            case ["relay", "on" | "off" as what, number] if _index(number) in self.board.numbers:
                self.board.set(_index(number), what == "on")
            case ["relay", "read", number] if _index(number) in self.board.numbers:
                return "on" if self.board.shows(_index(number)) else "off"
            case ["relay", "readall"]:
                return f"{sum(self.board.shows(number) << number for number in self.board.numbers):02x}"
            case ["gpio", "read", number] if _index(number) in range(COUNT):
                return "1" if self.board.level(_index(number)) else "0"
        return ""


def _index(text: str) -> int:
    """0 to 9, then A for 10 and so on; -1 for anything else."""
    return "0123456789ABCDEFGHIJKLMNOPQRSTUV".find(text) if len(text) == 1 else -1


class LcusPeer(SerialServer):
    """A board that switches a relay for four bytes with the right sum, and never answers."""

    def __init__(self, board: RelayBoard, *, pty: bool = False) -> None:
        self.board = board
        super().__init__("lcus", self._hear, pty=pty)

    def _hear(self, data: bytes, write: Callable[[bytes], object]) -> bytes:
        while len(data) >= 4:
            start, relay, what, total = data[:4]
            if start == 0xA0 and what in (0, 1) and total == (start + relay + what) & 0xFF:
                if relay in self.board.numbers:
                    self.board.set(relay, what == 1)
                data = data[4:]
            else:
                data = data[1:]
        return data
