"""Where the modules' loggers write: `run.log` in a run's folder, and the console.

Every module has a logger of its own, `logging.getLogger(__name__)`; nothing but the command line prints.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FILE_NAME = "run.log"
PACKAGES = ("cell", "drivers", "statemachine")
_FORMAT = "%(asctime)s.%(msecs)03d %(levelname)-7s %(name)s: %(message)s"
_DATE = "%Y-%m-%dT%H:%M:%S"


@contextmanager
def run_log(folder: Path) -> Iterator[None]:
    """While the context is open, what the modules log goes to `run.log` in `folder` as well."""
    handler = logging.FileHandler(folder / FILE_NAME, encoding="utf-8", delay=True)
    handler.setFormatter(logging.Formatter(_FORMAT, _DATE))
    loggers = [logging.getLogger(name) for name in PACKAGES]
    for logger in loggers:
        if logger.level == logging.NOTSET:
            logger.setLevel(logging.INFO)
        logger.addHandler(handler)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(handler)
        handler.close()


def console_log(verbosity: int) -> None:
    """Show warnings on standard error; what happens with `verbosity` 1, everything with 2."""
    handler = logging.StreamHandler()
    handler.setLevel({0: logging.WARNING, 1: logging.INFO}.get(verbosity, logging.DEBUG))
    handler.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
    for name in PACKAGES:
        logger = logging.getLogger(name)
        logger.addHandler(handler)
        logger.setLevel(logging.DEBUG if verbosity > 1 else logging.INFO)
