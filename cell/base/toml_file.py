"""TOML files as typed records: what is wrong in one is told by key and value, in our words, all of it at once."""

import json
import re
import tomllib
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from drivers.common.units import KEPT, shown
from drivers.errors import CellError, ConfigError

T = TypeVar("T", bound=BaseModel)

LARGEST_BYTES = 1_000_000
_WHERE = re.compile(r"\(at line (\d+), column (\d+)\)")


def below(folder: Path, *names: str) -> Path | None:
    """The regular file of these names below `folder`, or None: what a link leads elsewhere to, and a pipe, are none."""
    path = folder.joinpath(*names)
    try:
        inside = path.resolve(strict=True) == folder.resolve().joinpath(*names)
        return path if inside and path.is_file() else None
    except (OSError, ValueError, RuntimeError):
        return None


def read_toml(path: Path, what: str, how_to_make: str) -> dict[str, object]:
    """Parse a TOML file; every way that this fails is a `ConfigError` that names the file."""
    try:
        if path.is_dir():
            raise ConfigError(f"{what} {path} is a folder; name the file in it")
        if path.exists() and not path.is_file():
            raise ConfigError(f"{what} {path} is no regular file (a pipe or a device); name a file")
        if path.stat().st_size > LARGEST_BYTES:
            raise ConfigError(f"{what} {path} is larger than 1 MB, that is no {what}; name another file")
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise ConfigError(f"{what} {path} does not exist; `{how_to_make}` writes one to start from") from error
    except PermissionError as error:
        raise ConfigError(f"{what} {path} may not be read by you; change its permissions") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{what} {path} is no text in UTF-8 (byte {error.start + 1} is none); save it as UTF-8"
        ) from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{what} {path} cannot be read: {getattr(error, 'strerror', None) or error}") from error
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{what} {path} is not valid TOML{_what_is_wrong(str(error), text)}") from error


def _what_is_wrong(message: str, text: str) -> str:
    found = _WHERE.search(message)
    lines = text.splitlines()
    if found is None or not 1 <= int(found[1]) <= len(lines):
        return ": it ends in the middle of a value or of a table's name; close every quote and bracket"
    line, column = int(found[1]), int(found[2])
    twice = any(word in message for word in ("Cannot overwrite", "twice", "Cannot declare", "Cannot mutate"))
    hint = "this key or table is there already; remove one" if twice else 'write KEY = VALUE, and text in quotes "…"'
    return f", line {line}, column {column}: {lines[line - 1].strip()[:80]!r}; {hint}"


def validate(kind: type[T], data: dict[str, object], where: str) -> T:
    """Check parsed data against a record type; all problems go into one `ConfigError`, a line each."""
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        lines = dict.fromkeys(f"  {_key(problem['loc'])}{wording(problem)}" for problem in error.errors())
        raise ConfigError(f"{where} is not valid:\n" + "\n".join(lines)) from error


def restored(kind: type[T], path: Path) -> T:
    """The record that a run has kept as JSON, as it was, to the last digit; `CellError` when the file is no such."""
    try:
        return kind.model_validate(json.loads(path.read_text(encoding="utf-8")), context=KEPT)
    except (OSError, ValueError, RecursionError) as error:
        raise CellError(f"{path} cannot be read as what the run was done with: {str(error)[:500]}") from error


def _key(place: tuple[int | str, ...]) -> str:
    if not place:
        return ""
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).removeprefix(".")
    return f"{key}: "


def wording(problem: ErrorDetails) -> str:
    """What is wrong, for each kind of problem that a record's types can have."""
    kind, value, context = problem["type"], shown(problem.get("input")), problem.get("ctx", {})
    match kind:
        case "extra_forbidden":
            return "unknown key; check its spelling or remove it"
        case "missing" if isinstance(problem["loc"][-1], int):
            return "this value is missing; the list needs as many as in the file that `cell init` writes"
        case "missing":
            return "missing; `cell init` writes a complete file to compare with"
        case "value_error":
            return str(context["error"])
        case "literal_error":
            return f"{value} is not one of {context['expected'].replace(chr(39), chr(34))}"
        case "string_type":
            return f"{value} is no text; write it in quotes"
        case "string_too_short":
            return "is empty; write a text"
        case "string_too_long":
            return f"{value} is too long; at most {context['max_length']} characters are allowed"
        case "tuple_type":
            return f"{value} is no list; write it in brackets [ ]"
        case "too_long" | "too_short":
            return f"the list has {context['actual_length']} values" + (
                f"; at most {context['max_length']} are allowed" if kind == "too_long" else "; at least 1 is needed"
            )
        case "model_type" | "model_attributes_type":
            return (
                f"{value} is no table; write its keys below [{'.'.join(map(str, problem['loc']))}] or in braces {{ }}"
            )
    return f"{value} is not accepted here; `cell init` writes a file to compare with"
