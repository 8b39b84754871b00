"""The table of makes: the built-in ones and those that installed packages bring, found by kind and name.

A package's make is imported only when a configuration names it, or when somebody asks for the list. One that cannot be
imported, or that takes another's name, is told in the list with the reason, and keeps nothing else from working.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from pydantic import ValidationError, ValidationInfo
from pydantic_core import InitErrorDetails

from drivers.arm.make import ON_OUTPUTS, UR
from drivers.camera.genicam.make import GIGE, USB3
from drivers.camera.make import FOLDER, STREAM, V4L2
from drivers.claw.make import ROBOTIQ
from drivers.errors import ConfigError
from drivers.make import KINDS, AnyMake, DeviceConfig, Make, OnArm
from drivers.rail.modbus.make import MODBUS
from drivers.rail.tmcl.make import TMCL
from drivers.relay.make import RELAYS
from drivers.vehicle.cia402.make import CANOPEN
from drivers.vehicle.make import AGILEX, FIXED

BUILT_IN: tuple[AnyMake, ...] = (
    TMCL, UR, AGILEX, FIXED, CANOPEN, STREAM, *ON_OUTPUTS, GIGE, USB3, V4L2, FOLDER, MODBUS, *RELAYS, ROBOTIQ,
)  # fmt: skip
"""The makes that come with the cell. Of each kind the first is taken where a table names no `driver`."""

GROUP = "assembly_cell.devices"
"""Entry points that bring a make, named KIND.NAME; each leads to a `Make`."""


@dataclass(frozen=True)
class Installed:
    """A row of the list: `source` is "built in" or a package and its version, `state` "ok" or what is wrong."""

    kind: str
    make: str
    source: str
    state: str

    @property
    def ok(self) -> bool:
        """Whether a configuration can name it."""
        return self.state == "ok"


def installed() -> list[Installed]:
    """Every make there is, with those that cannot be used and why."""
    rows = [Installed(make.kind, make.name, "built in", _state(make)) for make in BUILT_IN]
    for entry in _entries():
        kind, _, name = entry.name.partition(".")
        try:
            state = _state(_load(entry))
        except _Unusable as problem:
            state = str(problem)
        rows.append(Installed(kind, name, _source(entry), state))
    order = list(KINDS)
    return sorted(rows, key=lambda row: order.index(row.kind) if row.kind in order else len(order))


def make_of(kind: str, name: str) -> AnyMake:
    """The make of that name; `ConfigError` that says what there is, or what is wrong with it."""
    for make in BUILT_IN:
        if (make.kind, make.name) == (kind, name):
            return make
    for entry in _entries():
        if entry.name == f"{kind}.{name}":
            try:
                return _load(entry)
            except _Unusable as problem:
                raise ConfigError(f'"{name}" of {_source(entry)} cannot be used: {problem}') from problem
    known = ", ".join(f'"{known}"' for known in _names(kind))
    raise ConfigError(f'no {kind} "{name}" is installed; known: {known}')


def record_of(kind: str) -> Callable[[object, object, ValidationInfo], DeviceConfig]:
    """A pydantic validator that reads a device's table as the record of the make that its `driver` names.

    Without `driver` it is the built-in make of that kind.
    """

    def read(value: object, _handler: object, info: ValidationInfo) -> DeviceConfig:
        if isinstance(value, KINDS[kind]):
            return value
        default = next(make for make in BUILT_IN if make.kind == kind)
        name = value.get("driver", default.name) if isinstance(value, dict) else default.name
        if not isinstance(name, str):
            raise _wrong_driver("string_type", name, {})
        # The installed packages are searched, which takes a while, for what is not built in alone.
        if not _is_built_in(kind, name) and name not in _names(kind):
            raise _wrong_driver("literal_error", name, {"expected": " or ".join(f"'{n}'" for n in _names(kind))})
        try:
            make = make_of(kind, name)
        except ConfigError as error:
            raise _wrong_driver("value_error", name, {"error": ValueError(str(error))}) from error
        record: DeviceConfig = make.record.model_validate(value, context=info.context)
        return record

    return read


def _state(make: AnyMake) -> str:
    missing = make.missing()
    return f"not installed: {missing}" if missing else "ok"


class _Unusable(Exception):
    """Why an entry point is no make."""


def _load(entry: EntryPoint) -> AnyMake:
    kind, _, name = entry.name.partition(".")
    if kind not in KINDS or not name:
        raise _Unusable(f'refused: the entry point is named "{entry.name}", not KIND.NAME with {", ".join(KINDS)}')
    if _is_built_in(kind, name):
        raise _Unusable("refused: a built-in make has this name")
    others = [_source(other) for other in _entries() if other.name == entry.name and other != entry]
    if others:
        raise _Unusable(f"refused: {', '.join(others)} brings a make of this name as well")
    try:
        made = entry.load()
    # Whatever a stranger's module does when it is imported, an exit included, is only its own failure.
    except (Exception, SystemExit) as error:
        raise _Unusable(f"broken: {type(error).__name__}: {error}") from error
    if not isinstance(made, Make):
        raise _Unusable(f"broken: {entry.value} is no Make but of type {type(made).__name__}")
    if (made.kind, made.name) != (kind, name):
        raise _Unusable(f'broken: {entry.value} says that it is "{made.kind}.{made.name}"')
    if not issubclass(made.record, KINDS[kind]):
        raise _Unusable(f"broken: its record {made.record.__name__} does not derive from {KINDS[kind].__name__}")
    if made.on_arm and not issubclass(made.record, OnArm):
        raise _Unusable(
            f"broken: it hangs on the arm, but its record {made.record.__name__} does not derive from OnArm, so nobody "
            "knows which of the arm's outputs is its own"
        )
    if unknown := made.calibrated - set(made.record.model_fields):
        raise _Unusable(f"broken: its record has no {', '.join(sorted(unknown))}, on which a calibration is to depend")
    return made


def _is_built_in(kind: str, name: str) -> bool:
    return any((make.kind, make.name) == (kind, name) for make in BUILT_IN)


def _entries() -> list[EntryPoint]:
    return sorted(entry_points(group=GROUP), key=lambda entry: (entry.name, _source(entry)))


def _names(kind: str) -> list[str]:
    own = [make.name for make in BUILT_IN if make.kind == kind]
    brought = {entry.name.partition(".")[2] for entry in _entries() if entry.name.startswith(f"{kind}.")}
    return own + sorted(brought - set(own))


def _source(entry: EntryPoint) -> str:
    return entry.value if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"


def _wrong_driver(kind: str, value: object, context: dict[str, Any]) -> ValidationError:
    details: InitErrorDetails = {"type": kind, "loc": ("driver",), "input": value, "ctx": context}
    return ValidationError.from_exception_data("driver", [details])
