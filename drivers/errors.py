"""The one error tree of the cell.

    CellError
    ├── ConfigError        a value in a file or on the command line is wrong: nothing was started
    ├── NotConnectedError  a device does not answer at its address, or was closed
    ├── DeadlineError      a device answered before, but not within its deadline this time
    ├── DeviceFault        a device reports a fault, or its driver found one (code, recoverable, hint)
    ├── InterlockError     a command was refused because it is not safe now; nothing was sent
    ├── LimitError         a command was refused because it leaves the limits; nothing was sent
    ├── CalibrationStale   the stored calibration is not the one of this cell as configured
    ├── RefusedError       a measurement is not good enough to go on
    │   └── NotObservable  a direction of the place pose is not known well enough
    └── Aborted            somebody asked for the end
        └── Interrupted    with Ctrl-C or a signal, outside a run

Every text says what happened, the value, the allowed range with units, and what to do next.

What has to be done at the end of a piece of work, without hiding why it ended.

Limits with units: the checks that every driver makes before it sends anything.

Values are SI; the text of an error shows them in the units that people read off a machine (mm, degrees, ms)."""

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Self, TypedDict


class CellError(Exception):
    """Base of every error that the cell raises on purpose; `str()` is fit to be shown to an operator."""


class ConfigError(CellError):
    """A configuration, job or command-line value is wrong. Example: `rail.lead = 2`, a number without its unit."""


class DeviceError(CellError):
    """Base of the errors that belong to one device, whose name is in `device`."""

    def __init__(self, device: str, message: str) -> None:
        super().__init__(f"{device}: {message}")
        self.device = device
        self.message = message

    def __reduce__(self) -> tuple[object, ...]:
        return (type(self), (self.device, self.message))


class NotConnectedError(DeviceError):
    """The device does not answer at its address, or the driver was closed. Example: the rail's port is missing."""


class DeadlineError(DeviceError):
    """An answer or the end of a motion did not come in time. Example: no TMCL reply within 0.2 s."""


class InterlockError(DeviceError):
    """The command is not safe in the present state; nothing was sent. Example: laser on without an owner."""


class LimitError(DeviceError):
    """The command leaves the device's limits; nothing was sent. Example: rail to 120 mm, allowed 0 to 100 mm."""


class DeviceFault(DeviceError):
    """The device reports a fault, or the driver found one. Example: the arm is in protective stop.

    `code` is short and stable, for scripts and for the recovery policy; `recoverable` says whether the driver's
    own recovery can clear it; `hint` tells the operator what to do next.
    """

    def __init__(self, device: str, code: str, message: str, *, recoverable: bool, hint: str) -> None:
        super().__init__(device, f"{message} ({code}). {hint}")
        self.code = code
        self.recoverable = recoverable
        self.hint = hint
        self._plain = message

    def __reduce__(self) -> tuple[object, ...]:
        return (_rebuild_fault, (self.device, self.code, self._plain, self.recoverable, self.hint))


def _rebuild_fault(device: str, code: str, message: str, recoverable: bool, hint: str) -> DeviceFault:
    return DeviceFault(device, code, message, recoverable=recoverable, hint=hint)


class CalibrationStale(CellError):
    """The stored calibration is missing, foreign or was made under another configuration."""


class MeasuredRow(TypedDict):
    """A `Measured` as reports have it; `bound` is "at least", "at most", "about" or None."""

    name: str
    value: float | None
    limit: float | None
    bound: str | None
    unit: str
    kept: bool


@dataclass(frozen=True)
class Measured:
    """A number in `unit` beside what it is held against: at least `least`, at most `most`, or `about` so much."""

    name: str
    value: float
    unit: str = ""
    least: float | None = None
    most: float | None = None
    about: float | None = None

    def as_dict(self) -> MeasuredRow:
        """JSON-ready."""
        bounds = (("at least", self.least), ("at most", self.most), ("about", self.about))
        bound, limit = next(((word, limit) for word, limit in bounds if limit is not None), (None, None))
        value, limit = (None if number is None else float(number) for number in (self.value, limit))
        return {"name": self.name, "value": value, "limit": limit, "bound": bound, "unit": self.unit, "kept": self.kept}

    @property
    def kept(self) -> bool:
        """True unless the value leaves its limit; `most` holds for either sign."""
        low = self.least is None or bool(self.value >= self.least)
        return low and (self.most is None or bool(abs(self.value) <= self.most))


class RefusedError(CellError):
    """A measurement is not good enough to go on. Example: the board is seen too obliquely.

    `numbers` are what the refusal rests on, with their limits; `seen` is what was looked at, by name (frames, a cloud,
    a pose), so that whoever ends the run can keep it. Neither is part of the text.
    """

    def __init__(self, message: str, *numbers: Measured) -> None:
        super().__init__(message)
        self.numbers: tuple[Measured, ...] = numbers
        self.seen: dict[str, object] = {}

    def showing(self, *numbers: Measured, seen: Mapping[str, object] | None = None) -> Self:
        """This error with more evidence; what is nearer to the cause came first and stays."""
        known = {number.name for number in self.numbers}
        self.numbers += tuple(number for number in numbers if number.name not in known)
        self.seen = {**(seen or {}), **self.seen}
        return self


class NotObservable(RefusedError):
    """A direction of the place pose is not known well enough; the text names it and its uncertainty."""


class MisplacedError(RefusedError):
    """The part was put down, looked at, and does not lie in its place; the text says how far off, and why."""


class Aborted(CellError):
    """The operator, a script or a signal asked for the end of the run; the text says who."""


class Interrupted(Aborted):
    """Ctrl-C or a signal ended work outside a run, and the cell was stopped; the text says what was not confirmed."""


_log = logging.getLogger(__name__)


@contextmanager
def in_the_end(action: Callable[[], object]) -> Iterator[None]:
    """Do `action` when the context is left, whatever happened inside.

    An error from inside stays the error. Should `action` fail as well, that is logged and noted on the first error
    (`__notes__`): what comes second is mostly its consequence, and a retry or a recovery has to judge the first. Raises
    what `action` raises when the work itself went well.
    """
    try:
        yield
    except BaseException as first:
        try:
            action()
        except CellError as second:
            _log.warning("after %r also: %s", first, second)
            first.add_note(f"and at its end: {second}")
        raise
    action()


UNTOLD = "not told"
"""In place of a model, serial number or version that a device does not tell."""
_SHOWN = {
    "m": ("mm", 1e3),
    "m/s": ("mm/s", 1e3),
    "m/s^2": ("mm/s^2", 1e3),
    "rad": ("deg", 180.0 / math.pi),
    "rad/s": ("deg/s", 180.0 / math.pi),
    "rad/s^2": ("deg/s^2", 180.0 / math.pi),
    "s": ("ms", 1e3),
}


def shown(value: float, unit: str) -> str:
    """`value` in the SI unit `unit` as text for people: 0.12, "m" reads "120 mm"; other units are shown as given."""
    name, factor = _SHOWN.get(unit, (unit, 1.0))
    return f"{value * factor:.6g} {name}"


def check_range(device: str, what: str, value: float, low: float, high: float, unit: str) -> float:
    """Return `value` if low ≤ value ≤ high, all in the SI unit `unit`.

    Raises `LimitError` naming `what`, the value and the allowed range otherwise, NaN and infinity included.
    """
    number = float(value)
    if math.isfinite(number) and low <= number <= high:
        return number
    raise LimitError(
        device,
        f"{what} {shown(number, unit)} is outside {shown(low, unit)} to {shown(high, unit)}; nothing was sent. "
        f"Choose a {what} in this range.",
    )


def check_positive(device: str, what: str, value: float, high: float, unit: str) -> float:
    """Return `value` if 0 < value ≤ high, both in the SI unit `unit`; `LimitError` otherwise."""
    number = float(value)
    if math.isfinite(number) and 0.0 < number <= high:
        return number
    raise LimitError(
        device,
        f"{what} {shown(number, unit)} is outside 0 (excluded) to {shown(high, unit)}; nothing was sent. "
        f"Choose a {what} in this range.",
    )
