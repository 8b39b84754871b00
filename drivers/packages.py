"""Packages that not every platform has a wheel of: imported when they are needed, and asked for by name.

Which platforms those are is said once, by the markers of `pyproject.toml`; docs/reference/platforms.md shows what that
leaves.
"""

from __future__ import annotations

import platform
from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from packaging.requirements import Requirement

_DISTRIBUTION = "assembly-cell"


def lacking(module: str, package: str) -> str:
    """What is missing and the remedy, in words; "" when `module`, which `package` brings, can be imported."""
    if find_spec(module) is not None:
        return ""
    wanted = _asked_for(package)
    here = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    if wanted.marker is None or wanted.marker.evaluate():
        return f"{package} is not installed for {here}: pip install '{wanted.name}{wanted.specifier}'"
    return (
        f"{package} has no wheel for {here}. Install the cell with Python 3.12 on Linux x86-64, where it has one; "
        "docs/reference/platforms.md shows what works where"
    )


def _asked_for(package: str) -> Requirement:
    """What this program's distribution asks for, with its marker; the bare package where it is not installed."""
    from importlib.metadata import PackageNotFoundError, requires

    from packaging.requirements import Requirement

    try:
        lines = requires(_DISTRIBUTION) or []
    except PackageNotFoundError:
        lines = []
    asked = (Requirement(line) for line in lines)
    return next((wanted for wanted in asked if wanted.name == package), Requirement(package))
