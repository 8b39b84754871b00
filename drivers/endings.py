"""What has to be done at the end of a piece of work, without hiding why it ended."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from drivers.errors import CellError

_log = logging.getLogger(__name__)


@contextmanager
def in_the_end(action: Callable[[], object]) -> Iterator[None]:
    """Do `action` when the context is left, whatever happened inside.

    An error from inside stays the error. Should `action` fail as well, that is logged and noted on the first error
    (`__notes__`): what comes second is mostly its consequence, and a retry or a recovery has to judge the first. Raises
    what `action` raises when the work itself went well.
    """
    try:
        yield
    except BaseException as first:
        try:
            action()
        except CellError as second:
            _log.warning("after %r also: %s", first, second)
            first.add_note(f"and at its end: {second}")
        raise
    action()
