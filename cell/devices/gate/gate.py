"""The gate through which all motion, the laser and the claw are begun: shut for work that is to end.

A stop ends what moves, but a step that plans or settles at that moment would begin its next motion after it. Work
therefore enters the gate with its cancel token: once that is cancelled, or the cell was stopped, it begins nothing
any more, in whatever thread it still goes on. Then the interlocks are asked whether the command is safe now. The
devices behind the gate are in `cell.devices.gate.gated`.
"""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, Protocol, TypeVar

from cell.devices.gate.interlocks import DeviceCommand, Interlocks
from drivers.errors import Aborted, InterlockError
from drivers.interfaces import Device, Identity
from statemachine.control import CancelToken

log = logging.getLogger(__name__)

Made = TypeVar("Made")
Bare = TypeVar("Bare", bound=Device)


class Listener(Protocol):
    """Is told what the cell's devices are asked to do, and what was read of them. Puts it aside, and never waits."""

    def command(self, command: DeviceCommand, refused: str | None) -> None:
        """A command is passed on, or `refused` for this reason."""

    def reading(self, device: str, reading: object) -> None:
        """This was read of a device."""


class Gate:
    """Counts the stops; each thread that works remembers the count at which it entered, and its token.

    Threads that never entered, such as a program's own, are let through until the first stop; after it a person has to
    `clear` it. That somebody else began a new run does not let them through.
    """

    def __init__(self, interlocks: Interlocks) -> None:
        self.interlocks = interlocks
        self.listener: Listener | None = None
        self._stops = 0
        self._cleared = 0
        self._entered = threading.local()
        # One command is checked and begun at a time: else two that exclude each other could both pass. Stopping never
        # takes this lock.
        self._beginning = threading.RLock()

    def enter(self, token: CancelToken) -> None:
        """Begin new work in this thread, which `token` ends."""
        self._entered.stops = self._stops
        self._entered.token = token

    @contextmanager
    def entered(self, token: CancelToken) -> Iterator[None]:
        """Inside this context this thread does work that `token` ends; afterwards it is what it was before."""
        outer = getattr(self._entered, "stops", None), getattr(self._entered, "token", None)
        self.enter(token)
        try:
            yield
        finally:
            self._entered.stops, self._entered.token = outer

    @property
    def stops(self) -> int:
        """How many there have been."""
        return self._stops

    def clear(self, stops: int | None = None) -> None:
        """The stops so far, or the first `stops` of them, keep no one any more but the work that they ended."""
        self._cleared = self._stops if stops is None else max(stops, self._cleared)

    @property
    def is_open(self) -> bool:
        """Whether threads that never entered are let through."""
        return self._cleared == self._stops

    def shut(self) -> None:
        """Bar all work that has entered so far. Comes before the devices are stopped."""
        self._stops += 1

    def require(self, command: DeviceCommand | None = None) -> None:
        """Raise when nothing may be begun by this thread, or when an interlock stands against the command.

        `Aborted` when this thread's work is to end or the cell was stopped since it entered; `InterlockError` when it
        never entered and nobody has cleared a stop, or when the command is not safe now.
        """
        try:
            self._require(command)
        except (Aborted, InterlockError) as refused:
            self.asked(command, str(refused))
            raise
        self.asked(command)

    def asked(self, command: DeviceCommand | None, refused: str | None = None) -> None:
        """Tell the listener that a command is passed on, or was refused."""
        if command is not None:
            self._notify(lambda listener: listener.command(command, refused))

    def seen(self, device: str, reading: object) -> None:
        """Tell the listener what was read of a device."""
        self._notify(lambda listener: listener.reading(device, reading))

    def _notify(self, notify: Callable[[Listener], None]) -> None:
        try:
            if (listener := self.listener) is not None:
                notify(listener)
        # Whatever is wrong with it, it keeps no command from passing, and no stop.
        except Exception as error:
            self.listener = None
            log.warning("what listened at the gate failed and is told nothing more: %s", error)

    def _require(self, command: DeviceCommand | None) -> None:
        token: CancelToken | None = getattr(self._entered, "token", None)
        if token is not None and token.reason is not None:
            raise Aborted(f"{token.reason}; nothing new is begun")
        stops: int | None = getattr(self._entered, "stops", None)
        if stops is not None and stops != self._stops:
            raise Aborted("the cell was stopped; nothing new is begun")
        if stops is None and not self.is_open:
            raise InterlockError(
                "cell",
                "was stopped, and nothing begins after that by itself (interlock after_a_stop). See that it is safe, "
                "then say so with clear_stop(by), or begin a run",
            )
        if command is not None:
            self.interlocks.require(command)

    def begin(self, command: DeviceCommand, start: Callable[[], Made], undo: Callable[[], None]) -> Made:
        """`start()`, if the command may pass; undone at once when the cell is stopped meanwhile."""
        with self._beginning:
            self.require(command)
            # The rules may have waited for a reading, and a stop have come meanwhile.
            self.require()
            made = start()
            try:
                self.require()
            except (Aborted, InterlockError):
                undo()
                raise
            return made


class Gated(Generic[Bare]):
    """What all devices behind the gate share: `bare` is the device, `gate` what its commands pass."""

    def __init__(self, bare: Bare, gate: Gate) -> None:
        self.bare = bare
        self.gate = gate
        self.name = bare.name
        self.statistics = bare.statistics

    def identity(self) -> Identity:
        return self.bare.identity()

    def ping(self) -> float:
        return self.bare.ping()

    def stop(self) -> None:
        self.gate.asked(DeviceCommand(self.name, "stop"))
        self.bare.stop()

    def close(self) -> None:
        self.bare.close()
