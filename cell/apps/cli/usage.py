"""A wrong command line as one line in our words, and what was meant to be typed instead."""

from __future__ import annotations

import re
import sys
from typing import Any

import typer

from cell.apps.cli import EXIT_USAGE
from drivers.errors import CellError, ConfigError

UsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""Base of what typer raises for a wrong command line, whichever parser it carries."""

_WORDS = (
    (r"Value error, ", ""),
    (r"Input should be", "it has to be"),
    (r"a valid integer(, .*)?", "a whole number"),
    (r"a valid number(, .*)?", "a number"),
    (r"\.$", ""),
)


class App(typer.Typer):
    """The table of commands. Called, it runs one and exits; a wrong command line is a `ConfigError`."""

    def __call__(self, *args: Any, **settings: Any) -> Any:
        """Run the command of `sys.argv`."""
        try:
            code = super().__call__(*args, **{**settings, "standalone_mode": False})
        except UsageError as error:
            if text := in_words(error):
                raise ConfigError(text) from error
            code = EXIT_USAGE
        except typer.Abort as error:
            raise CellError(
                "a question was not answered, so nothing was done; answer it, or give it as an option"
            ) from error
        sys.exit(code if isinstance(code, int) else 0)


def in_words(error: Any) -> str:
    """What is wrong, in one line, with the command whose help tells more; empty where the help was shown already."""
    if not (text := " ".join(str(error.format_message()).split())):
        return ""
    for pattern, word in _WORDS:
        text = re.sub(pattern, word, text)
    if re.search(r"No such command '(bench|paper)'", text):
        return f"{text}; the laboratory brings it: `pip install -e lab` in the checkout"
    command = error.ctx.command_path if error.ctx is not None else "cell"
    return f"{text}; `{command} --help` shows what may be given"
