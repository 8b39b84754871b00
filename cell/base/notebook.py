"""Results in a notebook: a short table, every word escaped."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

LONGEST = 240
"""Characters of a cell; a reason can be long, and the report has all of it."""


def table(title: str, rows: Iterable[tuple[str, str]]) -> str:
    """An HTML table of names and values under a title."""
    lines = "".join(f"<tr><th style='text-align:left'>{_safe(n)}</th><td>{_safe(v)}</td></tr>" for n, v in rows)
    return f"<table><caption>{_safe(title)}</caption>{lines}</table>"


def _safe(text: str) -> str:
    return escape(text if len(text) <= LONGEST else text[: LONGEST - 2] + " …")
