"""What tests share: benches, scenes, runs that ended, peers of others. Nothing here is a test."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[2]
"""The checkout."""
Typed = Callable[..., tuple[int, str, str]]
"""What the fixture `typed` gives: what a `cell` command comes to: exit code, output, complaints."""
