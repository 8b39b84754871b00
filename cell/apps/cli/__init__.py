"""The command line `cell`: one file per group of commands, imported only when a command of it runs.

Exit codes: 0 success, 1 a refused or failed run, 2 a usage or configuration error, 130 an interrupt (after the safe
stop).
"""

import os
import shlex
import sys
from pathlib import Path

EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 1, 2, 130
OPENING = (
    "run", "dry-run", "resume", "calibrate", "home", "jog", "diag", "commission", "console", "new-job", "sim",
    "qualify",
)  # fmt: skip
"""Commands that open a cell, or simulate one; `cell abort` and its like need little."""
LEAST_MEMORY_B = 3_000_000_000
"""Of addresses (`ulimit -v`): a run takes 2 GB on two cores, each further core some more for its threads."""


def main() -> None:
    """Entry point of the console script: runs a command and turns errors into a message and an exit code."""
    from statemachine.watch import EndSignals, SignalInterrupt

    _keep_standard_files()
    _require_memory()
    try:
        with EndSignals(keyboard=True):
            _run()
    except (SignalInterrupt, KeyboardInterrupt) as error:
        _complain(str(error) or "interrupted from the keyboard")
        sys.exit(EXIT_INTERRUPTED)


def _run() -> None:
    from cell.apps.cli.app import app
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
    from cell.config.files import NoConfiguration

    return f": `{shlex.join(['cell', *sys.argv[1:], '--sim', 'all'])}`" if isinstance(error, NoConfiguration) else ""


def _keep_standard_files() -> None:
    """Put nothing in the place of a closed standard file: one opened later, such as a record, would get its number, and
    what libraries print would go into it."""
    closed = []
    for number, name in enumerate(("standard input", "standard output", "standard error")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
            closed.append(name)
    sys.stdout = sys.stdout or Path(os.devnull).open("w")  # noqa: SIM115
    if "standard output" in closed:
        _complain("standard output is closed: what the command shows is lost; a run's report is in its folder")


def _require_memory() -> None:
    """Refuse a command that opens a cell where too little memory would end it without a word, in whatever it does."""
    import resource

    allowed = resource.getrlimit(resource.RLIMIT_AS)[0]
    command = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
    if command in OPENING and allowed != resource.RLIM_INFINITY and allowed < LEAST_MEMORY_B:
        _complain(
            f"this shell allows {1e-9 * allowed:.1f} GB of memory (ulimit -v), `cell {command}` needs "
            f"{1e-9 * LEAST_MEMORY_B:g} GB: with less the libraries end it, in the middle of a motion. Raise the limit"
        )
        sys.exit(EXIT_USAGE)


def say_unshown(how: str, error: BaseException) -> None:
    """Say on standard error how something ended whose end could not be shown, and let the rest of it go nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    why = error if isinstance(error, OSError) else "nobody reads its output any more"
    _complain(f"{how}, but that cannot be shown: {why}; `cell report` shows it")


def _complain(text: str) -> None:
    from contextlib import suppress

    from rich.console import Console

    # Where standard error is closed as well, the exit code tells.
    with suppress(OSError, SystemExit):
        Console(stderr=True, soft_wrap=True, highlight=False).print("error:", text, style="red", markup=False)
