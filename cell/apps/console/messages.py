"""What the program that has the cell and its server say to each other over their pipes, pickled.

Two pipes: one for everything, and one for the stop alone, on which nothing else can be under way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_STOPS = 2
"""So many are carried out at a time: one that lasts, and one more."""


@dataclass(frozen=True)
class ServerSetup:
    """How the server works; the first that it is told. `fd` is the socket that is bound for it already.

    `lasting` is the token of a file; `cert` and `key` are files for TLS. `cell` is what `/api/cell` answers.
    """

    fd: int
    port: int
    hosts: tuple[str, ...]
    lasting: str | None
    cert: str | None
    key: str | None
    runs: str
    cell: Mapping[str, object]


# --- server to cell ---


@dataclass(frozen=True)
class Ready:
    """The server answers; `token` opens it once."""

    token: str | None


@dataclass(frozen=True)
class Joined:
    """A page was opened."""

    client: str


@dataclass(frozen=True)
class Left:
    """A page is gone."""

    client: str


@dataclass(frozen=True)
class Do:
    """A page asks for something; answered by `Answer` of the same number."""

    number: int
    client: str
    words: Mapping[str, object]


@dataclass(frozen=True)
class AskCell:
    """What is `/api/cell` with this job's station? Answered by `Answer`."""

    number: int
    job: str


@dataclass(frozen=True)
class Beat:
    """A button is held; with `end` it is not any more."""

    client: str
    words: Mapping[str, object]
    end: bool = False


# --- cell to server ---


@dataclass(frozen=True)
class Answer:
    """To `Do` or `AskCell`: HTTP status and JSON."""

    number: int
    status: int
    words: Mapping[str, object]


@dataclass(frozen=True)
class Say:
    """To one page."""

    client: str
    words: Mapping[str, object]


@dataclass(frozen=True)
class Show:
    """The state, as JSON; newest only."""

    state: str


@dataclass(frozen=True)
class Happened:
    """Something for every page's list, as JSON."""

    event: str


@dataclass(frozen=True)
class ShownPicture:
    """A grey picture that is to be compressed and shown."""

    header: Mapping[str, Any]
    image: NDArray[np.uint8]


@dataclass(frozen=True)
class CloudPart:
    """An increment of the cloud."""

    header: Mapping[str, object]
    payload: bytes


# --- on the other pipe ---


@dataclass(frozen=True)
class StopCell:
    """Stop the cell; answered by `Stopped` of the same number."""

    number: int


@dataclass(frozen=True)
class Stopped:
    """It was stopped; `trouble` is what could not be confirmed."""

    number: int
    trouble: str | None
