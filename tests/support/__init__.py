"""What tests share: benches, scenes, runs that ended, peers of others. Nothing here is a test."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
"""The checkout."""
