"""Questions of a new job, each with its default: answered by an option, by a person, or by the default itself.

An answer is checked by the job file's own rule for that value. A wrong one is told with the range that is allowed; a
person is asked again, an option ends the command. The file that comes of the answers has every value with its unit.

The unit of a mesh: files such as STL do not say it. It is asked, or told by the size, never assumed in silence.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from cell.base.toml_file import wording
from cell.config.job import Job
from cell.run.report.page import render
from drivers.common.units import shown
from drivers.errors import ConfigError
from drivers.make import Mounting, Pose

METRES = {"mm": 1e-3, "m": 1.0, "inch": 0.0254}
LIKELY = (0.015, 0.45)
"""How long, m, the longer side of a surface is that one cell can sweep."""


def possible_units(longest: float) -> list[str]:
    """The units in which a mesh of this longest side is of a size that can be swept."""
    return [unit for unit, scale in METRES.items() if LIKELY[0] <= longest * scale <= LIKELY[1]]


def told_by_size(longest: float) -> tuple[str, str]:
    """The one unit that makes sense, and why, in words. Raises `ConfigError` where that is none, or several."""
    found = possible_units(longest)
    sizes = size_words(longest)
    if len(found) == 1:
        return found[0], f"taken as {found[0]}: of {sizes}, that alone can be swept"
    if not found:
        raise ConfigError(
            f"the mesh's longest side is {longest:.4g}: {sizes} (allowed: {1e3 * LIKELY[0]:g} to {1e3 * LIKELY[1]:g} "
            "mm), so no unit makes it a surface that one cell sweeps; cut it to what the part is placed onto, or name "
            "its unit with --unit"
        )
    raise ConfigError(
        f"the mesh's longest side is {longest:.4g}: {sizes}; which it is cannot be told: name it with --unit "
        f"{'|'.join(METRES)}"
    )


def size_words(longest: float) -> str:
    """What that side is in each unit."""
    return ", ".join(f"{1e3 * longest * scale:.4g} mm if in {unit}" for unit, scale in METRES.items())


def job_text(job: Job, heading: Sequence[str]) -> str:
    """The file of a job, as `job.toml.jinja` has it. `heading` are the lines of comment at its top: where it comes
    from, what was decided."""
    return render(
        __package__, "job.toml.jinja", job=job, heading=heading, mm=mm, deg=deg, pose=pose_text,
        mms=lambda lengths: ", ".join(map(mm, lengths)),
    )  # fmt: skip


def mm(metres: float) -> str:
    """A length, quoted."""
    return f'"{_plain(1e3 * metres)} mm"'


def deg(radians: float) -> str:
    """An angle, quoted."""
    return f'"{_plain(math.degrees(radians))} deg"'


def pose_text(pose: Pose) -> str:
    """A pose as an inline table."""
    there, turn = ", ".join(map(mm, pose.translation)), ", ".join(map(deg, pose.rotation))
    return f"{{ translation = [{there}], rotation = [{turn}] }}"


def _plain(value: float) -> str:
    """No more digits than were meant: what arithmetic added in the last place is not."""
    return f"{round(value, 6):.10g}".replace("-0", "0") if round(value, 6) == 0 else f"{round(value, 6):.10g}"


PROGRESS_S = 3.0

T = TypeVar("T")
P = TypeVar("P", bound=Pose)


@dataclass(eq=False)
class Asker:
    """Asks the questions. `given` are the options by name, None for those that were not given; `ask` puts a question
    with its default to a person, None where nobody is there; `notify` says something to that person.

    `used` collects what was answered, as options that would answer the same.
    """

    given: Mapping[str, str | None]
    ask: Callable[[str, str | None], str] | None
    notify: Callable[[str], None]
    used: dict[str, str] = field(default_factory=dict)
    _told: float = -math.inf

    def progress(self, text: str) -> None:
        """Tell how far something is, unless that was told less than `PROGRESS_S` ago."""
        if time.monotonic() >= self._told + PROGRESS_S:
            self._told = time.monotonic()
            self.notify(f"  {text} …")

    def get(self, option: str, question: str, default: str | None, parse: Callable[[str], T]) -> T:
        """The answer to a question, by `parse`, which raises `ValueError` or `ConfigError` for a wrong one.

        Raises `ConfigError` for a wrong option, and for a question without default that nobody answers.
        """
        text = self.given.get(option)
        if text is None and self.ask is None:
            if default is None:
                raise ConfigError(f"{question}? Nobody is asked with --yes, and there is no default: give --{option}")
            text = default
        while True:
            answer = text
            if answer is None:
                assert self.ask is not None
                answer = self.ask(question, default)
            try:
                found = parse(answer)
            except (ValueError, ConfigError) as error:
                if text is not None:
                    raise ConfigError(f"--{option}: {error}") from error
                self.notify(str(error))
                continue
            if answer != default:
                self.used[option] = answer
            return found


def checked(record: type[BaseModel], key: str) -> Callable[[str], Any]:
    """Parses a value by the rule of the key of a job's section."""
    adapter = _rule(record, key)
    return lambda text: _by(adapter, text.strip())


def three(record: type[BaseModel], key: str) -> Callable[[str], object]:
    """Parses three values, such as "70 mm, 36 mm, 20 mm", by the rule of the key."""
    adapter = _rule(record, key)

    def parse(text: str) -> object:
        parts = [part.strip() for part in text.split(",")]
        if len(parts) != 3:
            raise ValueError(f'{shown(text)} has {len(parts)} values; write three, such as "70 mm, 36 mm, 20 mm"')
        return _by(adapter, parts)

    return parse


def pose(kind: type[P]) -> Callable[[str], P]:
    """Parses "x, y, z" or "x, y, z; roll, pitch, yaw", each with its unit."""

    def parse(text: str) -> P:
        halves = [[part.strip() for part in half.split(",")] for half in text.split(";")]
        if len(halves) > 2 or any(len(half) != 3 for half in halves):
            raise ValueError(
                f'{shown(text)} is no pose; write three lengths, and three angles if it is turned, such as "0 mm, '
                '0 mm, 5 mm; 0 deg, 0 deg, 90 deg"'
            )
        turn = halves[1] if len(halves) == 2 else ["0 deg"] * 3
        made: P = _by(TypeAdapter(kind), {"translation": halves[0], "rotation": turn})
        return made

    return parse


def pose_words(where: Pose | Mounting) -> str:
    """A pose as `pose` reads it."""
    there, turn = (", ".join(map(write, each)) for write, each in ((mm, where.translation), (deg, where.rotation)))
    return f"{there}; {turn}".replace('"', "")


def choice(*words: str) -> Callable[[str], str]:
    """Parses one of these words."""

    def parse(text: str) -> str:
        if text.strip() not in words:
            raise ValueError(f"{shown(text)} is none of {', '.join(words)}; write one of them")
        return text.strip()

    return parse


def _rule(record: type[BaseModel], key: str) -> TypeAdapter[Any]:
    rule: Any = record.model_fields[key]
    kind: Any = Annotated[rule.annotation, *rule.metadata] if rule.metadata else rule.annotation
    return TypeAdapter(kind)


def _by(adapter: TypeAdapter[Any], value: object) -> Any:
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        raise ValueError("; ".join(dict.fromkeys(wording(problem) for problem in error.errors()))) from error
