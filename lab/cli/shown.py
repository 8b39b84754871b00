"""What the laboratory's commands have in common: a bar while they work, tables, and JSON instead of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from typing import Any, Protocol

from cell.apps.cli.options import new_table, print_json


class Told(Protocol):
    """Called with how much is done, what is done now, and how much is all."""

    def __call__(self, done: float, text: str = "", total: float = 1.0) -> None:
        """See the class."""


@contextmanager
def bar() -> Iterator[Told]:
    """A bar on standard error; gives what to call for it to grow."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=None)

        def told(done: float, text: str = "", total: float = 1.0) -> None:
            progress.update(task, completed=done, total=total, description=text)
            if text and not progress.console.is_terminal:
                # A log shows no bar until its end.
                progress.console.print(text, markup=False)

        yield told


def counted(told: Told, total: float) -> Callable[[str], None]:
    """What to call with a text once for each of `total` things that are done."""
    number = count(1)
    return lambda text: told(next(number), text, total)


def empty(title: str, *columns: str) -> Any:
    """A table without rows. The first column is text, others are numbers but for those that begin with '<'."""
    first, *others = columns
    return new_table(title, first, *(name[1:] if name.startswith("<") else f">{name}" for name in others))


def table(title: str, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> Any:
    """A table with `columns` as of `empty` and its rows; None is shown as nothing."""
    made = empty(title, *columns)
    for row in rows:
        made.add_row(*("" if value is None else str(value) for value in row))
    return made


def formed(title: str, columns: Mapping[str, str], rows: Iterable[Mapping[str, Any]]) -> Any:
    """A table of dictionaries: under each heading what the pattern makes of a row; nothing where it names a None."""

    def cell(pattern: str, row: Mapping[str, Any]) -> str | None:
        try:
            return pattern.format(**row)
        except TypeError:  # A None has no digits.
            return None

    return table(title, columns, ([cell(pattern, row) for pattern in columns.values()] for row in rows))


def show(result: Any, json: bool, printed: Callable[[Any], None]) -> None:
    """The result as JSON on standard output, or as `printed` shows it to people."""
    if json:
        print_json(result)
    else:
        printed(result)
