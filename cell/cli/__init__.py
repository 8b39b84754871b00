"""The command line `cell`: one file per group of commands, imported only when a command of it runs.

Exit codes: 0 success, 1 a refused or failed run, 2 a usage or configuration error, 130 an interrupt (after the safe
stop).
"""

from __future__ import annotations

import shlex
import sys

EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 1, 2, 130


def main() -> None:
    """Entry point of the console script: runs a command and turns errors into a message and an exit code."""
    from statemachine.watch import EndSignals, SignalInterrupt

    try:
        with EndSignals(keyboard=True):
            _run()
    except (SignalInterrupt, KeyboardInterrupt) as error:
        _complain(str(error) or "interrupted from the keyboard")
        sys.exit(EXIT_INTERRUPTED)


def _run() -> None:
    from cell.cli.app import app
    from drivers.errors import CellError, ConfigError, Interrupted
    from statemachine.journal import JournalError

    try:
        app(standalone_mode=True)
    except Interrupted as error:
        _complain(str(error))
        sys.exit(EXIT_INTERRUPTED)
    except ConfigError as error:
        _complain(f"{error}{_simulated_form(error)}")
        sys.exit(EXIT_USAGE)
    except (CellError, JournalError, OSError) as error:
        _complain(str(error))
        sys.exit(EXIT_FAILED)


def _simulated_form(error: Exception) -> str:
    """The command that was typed, for a simulated cell, where there is no configuration of a real one."""
    from cell.which_config import NoConfiguration

    return f": `{shlex.join(['cell', *sys.argv[1:], '--sim', 'all'])}`" if isinstance(error, NoConfiguration) else ""


def _complain(text: str) -> None:
    from rich.console import Console

    Console(stderr=True, soft_wrap=True, highlight=False).print("error:", text, style="red", markup=False)
