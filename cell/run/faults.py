"""What an error means for a run, of a job or of other work, and how the fault behind it is cleared."""

from __future__ import annotations

from dataclasses import replace

from cell.base.lateness import LATENESS, MOST_S
from cell.devices.devices import Devices
from cell.devices.simulated.following import DeviceFollowing
from drivers.errors import (
    Aborted,
    CalibrationStale,
    CellError,
    ConfigError,
    DeadlineError,
    DeviceError,
    DeviceFault,
    NotConnectedError,
    RefusedError,
)
from statemachine.cancel import CancelToken
from statemachine.policy import Failure, Outcome

CONFIRMED_BY_A_PERSON = frozenset(("arm.protective_stop",))
"""Faults that no program may clear by itself: the maker asks that a person looks at the arm first."""


UNHEARD = frozenset(("arm.link_lost", "arm.program_stopped"))
"""Faults of a device that was not heard, or did not hear, in time."""
BUSY = "this computer is too busy"


def classify(error: BaseException, following: DeviceFollowing | None = None) -> Failure:
    """What an exception means for the run; what failed besides, as it was ended, is told after it.

    What a person is asked says what is simulated beside real devices (`following`).
    """
    failure = _classify(error)
    if notes := getattr(error, "__notes__", ()):
        failure = replace(failure, reason="; ".join([failure.reason, *notes]))
    unheard = isinstance(error, DeadlineError | NotConnectedError) or failure.code in UNHEARD
    if unheard and (late := LATENESS.worst) > MOST_S and BUSY not in failure.reason:
        said = failure.reason.rstrip(".")
        failure = replace(failure, reason=f"{said}. {BUSY.capitalize()}: it woke up {1e3 * late:.0f} ms late.")
    if not failure.needs_person or following is None:
        return failure
    names = ", ".join(following.simulated)
    return replace(failure, reason=f"{failure.reason} (simulated here: {names}; all else is real)")


def _classify(error: BaseException) -> Failure:
    match error:
        case RefusedError() | CalibrationStale() | ConfigError():
            return Failure(Outcome.REFUSED, str(error), type(error).__name__, error=error)
        case Aborted():
            return Failure(Outcome.ABORTED, str(error), "aborted")
        case DeviceFault():
            person = error.code in CONFIRMED_BY_A_PERSON
            return Failure(Outcome.FAULTED, str(error), error.code, error.recoverable, person)
        case CellError():
            return Failure(Outcome.FAULTED, str(error), type(error).__name__)
    return Failure(Outcome.FAULTED, f"unexpected {type(error).__name__}: {error}", "internal")


def clear(devices: Devices, error: BaseException, token: CancelToken, confirmed: bool) -> None:
    """Clear the fault of a device, as far as a program may; a camera or the rail only needs its work done again."""
    with devices.gate.entered(token):
        token.check()
        if isinstance(error, DeviceError) and error.device in ("arm", "laser", "claw"):
            devices.arm.recover(confirmed=confirmed)
        elif isinstance(error, DeviceError) and error.device == "vehicle":
            devices.vehicle.recover()
