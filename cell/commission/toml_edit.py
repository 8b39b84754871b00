"""Changing values in a TOML file without touching the rest of it: comments, order and spaces stay as they are.

Only keys that stand on a line of their own below a plain [table] header are changed, or added there. The new text is
parsed again and has to say exactly what was meant; else nothing is written. The old file is always kept.
"""

from __future__ import annotations

import os
import re
import shutil
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivers.errors import ConfigError

_HEADER = re.compile(r"\s*\[([^\[\]]+)\]\s*(#.*)?$")
_ANY_HEADER = re.compile(r"\s*\[")


def edited(text: str, changes: Mapping[str, str]) -> str:
    """`text` with each dotted key of `changes` set to its value, given as TOML. `ConfigError` when that fails."""
    wanted = tomllib.loads(text)
    for key, value in changes.items():
        text = _set(text, key, value)
        table, _, name = key.rpartition(".")
        _table(wanted, table)[name] = tomllib.loads(f"x = {value}")["x"]
    try:
        good = tomllib.loads(text) == wanted
    except tomllib.TOMLDecodeError:
        good = False
    if not good:
        raise ConfigError(
            "the configuration is written in a way that this program does not change without risk; write yourself: "
            + "; ".join(f"{key} = {value}" for key, value in changes.items())
        )
    return text


def write_changes(path: Path, changes: Mapping[str, str]) -> Path:
    """Change the file, and keep the old one beside it; returns where that is. `ConfigError` when it cannot be done."""
    try:
        text = path.read_text(encoding="utf-8")
        new = edited(text, changes)
        backup = _free(path)
        shutil.copy2(path, backup)
        beside = path.with_name(f".{path.name}.{os.getpid()}")
        beside.write_text(new, encoding="utf-8")
        shutil.copymode(path, beside)
        beside.replace(path)
    except OSError as error:
        raise ConfigError(f"{path} cannot be changed: {error.strerror or error}; see its permissions") from error
    return backup


def _free(path: Path) -> Path:
    stamp = time.strftime("%Y%m%d-%H%M%S")
    names = [f"{path.name}.before-{stamp}", *(f"{path.name}.before-{stamp}-{k}" for k in range(2, 100))]
    return next(path.with_name(name) for name in names if not path.with_name(name).exists())


def _table(tables: dict[str, Any], dotted: str) -> dict[str, Any]:
    for part in dotted.split("."):
        tables = tables.setdefault(part, {})
    return tables


def _set(text: str, key: str, value: str) -> str:
    table, _, name = key.rpartition(".")
    lines = text.splitlines(keepends=True)
    begin = next((k + 1 for k, line in enumerate(lines) if _named(line) == table), None)
    if begin is None:
        return f"{text.rstrip()}\n\n[{table}]\n{name} = {value}\n"
    end = next((k for k in range(begin, len(lines)) if _ANY_HEADER.match(lines[k])), len(lines))
    for k in range(begin, end):
        if re.match(rf"\s*{re.escape(name)}\s*=", lines[k]):
            last = _last_line(lines, k, end)
            lines[k : last + 1] = [_replaced("".join(lines[k : last + 1]), value)]
            return "".join(lines)
    lines.insert(begin, f"{name} = {value}\n")
    return "".join(lines)


def _named(line: str) -> str | None:
    found = _HEADER.match(line)
    return None if found is None else ".".join(part.strip() for part in found[1].split("."))


def _last_line(lines: list[str], first: int, end: int) -> int:
    """Where the value that begins in line `first` ends: from there on the lines are TOML by themselves."""
    for last in range(first, end):
        try:
            tomllib.loads("".join(lines[first : last + 1]))
        except tomllib.TOMLDecodeError:
            continue
        return last
    return first


def _replaced(statement: str, value: str) -> str:
    """`KEY = OLD # comment` with another value; the comment keeps its column where there is room."""
    head, _, rest = statement.partition("=")
    comment = _comment(rest)
    line = f"{head.rstrip()} = {value}"
    if comment:
        column = len(statement) - len(statement[statement.rindex(comment) :]) if "\n" not in statement.rstrip() else 0
        line = f"{line.ljust(max(column, len(line) + 2))}{comment}"
    return f"{line}\n"


def _comment(rest: str) -> str:
    """The comment at the end of a value, with its #; empty without one."""
    for place in (match.start() for match in re.finditer("#", rest)):
        try:
            tomllib.loads(f"x = {rest[:place].strip()}")
        except tomllib.TOMLDecodeError:
            continue
        return rest[place:].strip() if "\n" not in rest[place:].strip() else ""
    return ""
