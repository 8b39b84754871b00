"""Changing values in a TOML file without touching the rest of it: comments, order and spaces stay as they are.

The new text is parsed again and has to say what was meant; else nothing is written. The old file is always kept.
"""

from __future__ import annotations

import os
import shutil
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from drivers.errors import ConfigError


def edited(text: str, changes: Mapping[str, str]) -> str:
    """`text` with each dotted key of `changes` set to its value, given as TOML. `ConfigError` when that fails."""
    wanted = tomllib.loads(text)
    try:
        document = tomlkit.parse(text)
        for key, value in changes.items():
            table, _, name = key.rpartition(".")
            _table(document, table)[name] = tomlkit.value(value)
            _table(wanted, table)[name] = tomllib.loads(f"x = {value}")["x"]
        new = document.as_string()
        good = tomllib.loads(new) == wanted
    except (TOMLKitError, tomllib.TOMLDecodeError, TypeError):
        good = False
    if not good:
        raise ConfigError(
            "the configuration is written in a way that this program does not change without risk; write yourself: "
            + "; ".join(f"{key} = {value}" for key, value in changes.items())
        )
    return new


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


def _table(tables: Any, dotted: str) -> Any:
    for part in dotted.split("."):
        tables = tables.setdefault(part, {})
    return tables
