"""Work outside a job, such as calibrating or jogging: on an interrupt or any error the cell is stopped first."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from cell.assembly import Devices
from drivers.errors import Aborted, DeviceFault, Interrupted
from statemachine.watch import Call, SignalWatch

POLL_S = 0.05
GRACE_S = 5.0
"""Wall seconds that stopped work has to end."""

Made = TypeVar("Made")


def guarded(devices: Devices, what: str, work: Callable[[Callable[[], None]], Made]) -> Made:
    """Do `work` in a thread; on Ctrl-C or any error stop the cell first, then raise.

    `work` is given a function that raises once the work is to end, to be called between motions. Raises `Interrupted`
    after a signal, `DeviceFault` when the stop was not confirmed, else what `work` raised.
    """
    made: list[Made] = []
    with SignalWatch() as signals:

        def check() -> None:
            if signals.reason is not None:
                raise Aborted(f"{what} {signals.reason}")

        def begin() -> None:
            devices.gate.enter()
            check()
            made.append(work(check))

        call = Call(what, begin)
        while not call.done.wait(POLL_S) and signals.reason is None:
            pass
        if signals.reason is not None or call.error is not None:
            problems = devices.stop()
            call.done.wait(GRACE_S)
            unconfirmed = f"; not confirmed: {'; '.join(problems)}" if problems else ""
            if signals.reason is not None:
                raise Interrupted(f"{what} {signals.reason}; the cell was stopped{unconfirmed}")
            if problems:
                raise stop_not_confirmed(f"{what}: {call.error}{unconfirmed}") from call.error
            assert call.error is not None
            raise call.error
    return made[0]


def stop_not_confirmed(message: str) -> DeviceFault:
    """The fault of a cell of which it is not known that it stands."""
    return DeviceFault("cell", "safe_stop", message, recoverable=False, hint="Look at the cell before going near it.")
