"""How fast work moves arm and vehicle, of what is planned: a person who wants to look closely slows them down."""

from __future__ import annotations

from drivers.errors import ConfigError

LEAST = 0.25
"""Slower than this, steps of a usual length would not end within their deadlines."""


class Pace:
    """The `share` holds from the next motion on, until it is set again; any thread may set it.

    Slowed are the arm's motions and the vehicle's ways. Sweeps keep their speed: the lines on the surface would lie
    closer than the job has them.
    """

    def __init__(self) -> None:
        self._share = 1.0

    @property
    def share(self) -> float:
        """Of the planned speed, `LEAST` to 1; raises `ConfigError` when it is set to anything else."""
        return self._share

    @share.setter
    def share(self, share: object) -> None:
        self._share = require_share(share)


def require_share(share: object) -> float:
    """`share` if it is one; raises `ConfigError` that says what is allowed."""
    if not isinstance(share, int | float) or isinstance(share, bool) or not LEAST <= share <= 1.0:
        raise ConfigError(f"pace {share!r}: allowed are {LEAST:g} to 1, of the planned speed")
    return float(share)
