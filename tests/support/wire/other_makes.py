"""Tables of other makes as docs/how-to/other-makes.md prints them, and cells with them."""

import re
import tomllib
from typing import Any

import pytest

from cell.config.cell_config import CellConfig, tables_of, validate
from drivers.errors import ConfigError
from tests.support import ROOT

PRINTED = [
    tomllib.loads(block)
    for block in re.findall(
        r"```toml\n(.*?)```", (ROOT / "docs" / "how-to" / "other-makes.md").read_text(encoding="utf-8"), re.DOTALL
    )
]


MODBUS, NUMATO, LCUS, ROBOTIQ = PRINTED


def cell(*tables: dict[str, Any], **changed: Any) -> CellConfig:
    """The stock cell with these tables instead of its own, and `device__key` values changed."""
    made = tables_of(None)
    for table in tables:
        made |= table
    for key, value in changed.items():
        device, _, name = key.partition("__")
        made[device] = {**made[device], name: value}
    return validate(CellConfig, made, "cell.toml")


def refusal_of(*tables: dict[str, Any]) -> str:
    """What is said of a cell with these tables."""
    with pytest.raises(ConfigError) as met:
        cell(*tables)
    return str(met.value)
