"""The schemas of what a page may say: commands of `POST /api/do` and messages of the live link
(docs/reference/console.md).

Both the server and the desk check by them: numbers finite and in range, texts of bounded length, no unknown keys.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from drivers.errors import ConfigError

LEAST_SPEED, LEAST_PACE = 0.05, 0.25

Name = Annotated[str, Field(max_length=40)]
Text = Annotated[str, Field(max_length=400)]
Identifier = Annotated[str, Field(pattern=r"^[a-z_]{1,40}$")]
Axis = Annotated[str, Field(pattern=r"^[a-z]{0,3}[1-6]?$")]
Client = Annotated[str, Field(pattern=r"^c[0-9]{1,12}$")]
Run = Annotated[str, Field(pattern=r"^[0-9]{8}T[0-9]{6}-[0-9a-f]{4}$")]
Count = Annotated[int, Field(ge=0, le=2**53)]
Seed = Annotated[int, Field(ge=0, le=999_999)]
Step = Annotated[float, Field(ge=-100.0, le=100.0)]
"""Of a jog, m or rad; the cell's own limits are narrower."""
Clock = Annotated[float, Field(ge=0.0, le=1e15)]
"""Of a page, ms."""
Device = Literal["rail", "arm", "vehicle"]


class PageMessage(BaseModel):
    """Anything that a page says."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _said(**fields: Any) -> type[PageMessage]:
    """A schema of these fields, each its type and its default (... where it has to be said)."""
    return create_model("PageMessage", __base__=PageMessage, **fields)


_OF_JOB = _said(job=(Text | None, None))

COMMANDS: dict[str, type[PageMessage]] = {
    "hold": _said(name=(Name, "")),
    "leave": _said(),
    "hand_over": _said(to=(Client, ...)),
    "clear_stop": _said(by=(Text, ...)),
    "recover": _said(by=(Text | None, None)),
    "start": _said(job=(Text | None, None), until=(Identifier | None, None), at_start=(bool, False)),
    "resume": _said(run=(Run | None, None)),
    "dry_run": _said(job=(Text | None, None), seed=(Seed | None, None)),
    "cancel_dry_run": _said(),
    "pause": _said(),
    "go_on": _said(),
    "abort": _said(reason=(Text, "asked for at the operator's screen")),
    "decide": _said(
        number=(Count, ...), choice=(Identifier, ...), step=(Identifier | None, None), by=(Text | None, None),
        reason=(Text, ...),
    ),
    "calibrate": _OF_JOB,
    "verify": _OF_JOB,
    "home": _said(device=(Literal["rail", "arm"] | None, None)),
    "diag": _said(),
    "manual": _said(on=(bool, False)),
    "jog_step": _said(device=(Device, ...), axis=(Axis, ""), amount=(Step, ...)),
    "speed": _said(fraction=(Annotated[float, Field(ge=LEAST_SPEED, le=1.0)], ...)),
    "pace": _said(share=(Annotated[float, Field(ge=LEAST_PACE, le=1.0)], ...)),
}  # fmt: skip
"""By `do`; `stop` is not among them: it is carried out whatever else is said with it."""

MESSAGES: dict[str, type[PageMessage]] = {
    "jog": _said(
        press=(Count, ...), device=(Device, ...), axis=(Axis, ""), sign=(Literal[1, -1], ...), at=(Clock | None, None)
    ),
    "jog_end": _said(press=(Count, 0)),
}
"""Of the live link, by `type`; `stop` is not among them, either."""


def checked_command(words: Mapping[str, object]) -> dict[str, object]:
    """The arguments of a command, with those that were left out; `ConfigError` says what is wrong with it."""
    return _checked(COMMANDS, "do", words)


def checked_message(words: Mapping[str, object]) -> dict[str, Any]:
    """The same of a message of the live link."""
    return _checked(MESSAGES, "type", words)


def _checked(schemas: Mapping[str, type[PageMessage]], kind: str, words: Mapping[str, object]) -> dict[str, object]:
    name = words.get(kind)
    schema = schemas.get(name) if isinstance(name, str) else None
    if schema is None:
        given = f"called {name[:40]!r}" if isinstance(name, str) else "without a name"
        raise ConfigError(f"there is nothing {given} to do; docs/reference/console.md lists what there is")
    try:
        told = schema.model_validate({key: value for key, value in words.items() if key != kind})
    except ValidationError as error:
        # Not the value itself: it may be thousands of digits.
        wrong = "; ".join(
            f"{'.'.join(str(part)[:40] for part in problem['loc'])}: {problem['msg']}"
            for problem in error.errors(include_url=False, include_input=False)[:4]
        )
        raise ConfigError(f"{name} is not understood: {wrong}. docs/reference/console.md lists what it takes") from None
    return told.model_dump()
