"""Which release of the cell this is, for `cell --version` and for reports."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

DISTRIBUTION = "assembly-cell"


def release() -> str:
    """The version of the installed distribution; "not installed" when it runs from a checkout alone."""
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        return "not installed"
