"""What the laboratory's commands have in common: a bar while they work, then the result as JSON or as tables.

Every result is plain data whose keys carry their units. One way of showing serves them all.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count
from typing import TYPE_CHECKING, Protocol

import typer

from cell.apps.cli.options import new_table, print_json, wide_console

if TYPE_CHECKING:
    from rich.console import Console


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


def show(result: Mapping[str, object], json: bool, without: Collection[str] = (), *, failed: object = False) -> None:
    """The whole result as JSON on standard output, or tables of it without some keys; exit code 1 where it `failed`."""
    if json:
        print_json(result)
    else:
        _show(wide_console(150), "", result, without)
    if failed:
        raise typer.Exit(1)


def _show(console: Console, title: str, value: object, without: Collection[str]) -> None:
    """A list of records, or a map of them, as one table; of other maps the values, then each deeper part by itself."""
    if isinstance(value, Mapping):
        known = {str(key): entry for key, entry in value.items() if key not in without}
        if len(known) > 1 and all(_is_record(entry) for entry in known.values()):
            _table(console, title, [{"of": key, **_flat(entry)} for key, entry in known.items()])
            return
        plain = {key: entry for key, entry in known.items() if _is_single(entry) or _is_plain(entry)}
        if plain:
            _table(console, title, [{"of": key, "value": entry} for key, entry in _flat(plain).items()])
        for key, entry in known.items():
            if key not in plain:
                _show(console, f"{title}, {key}" if title else key, entry, without)
    elif isinstance(value, Sequence):
        _table(console, title, [_flat(row) for row in value])


def _is_single(value: object) -> bool:
    return isinstance(value, str) or not isinstance(value, (Mapping, Sequence)) or _is_list(value)


def _is_list(value: object) -> bool:
    return isinstance(value, Sequence) and not any(isinstance(entry, (Mapping, list)) for entry in value)


def _is_plain(value: object) -> bool:
    return isinstance(value, Mapping) and all(map(_is_single, value.values()))


def _is_record(value: object) -> bool:
    """True for a map of single values, or of maps of these."""
    return isinstance(value, Mapping) and _is_plain(_flat(value))


def _flat(value: object) -> dict[str, object]:
    """A record whose inner maps are further columns, named after both keys."""
    if not isinstance(value, Mapping):
        return {"value": value}
    made: dict[str, object] = {}
    for key, entry in value.items():
        if isinstance(entry, Mapping):
            made |= {f"{key} {inner}": one for inner, one in entry.items()}
        else:
            made[str(key)] = entry
    return made


def _table(console: Console, title: str, rows: Sequence[Mapping[str, object]]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = new_table(title.replace("_", " "), *(name.replace("_", " ") for name in names))
    for row in rows:
        table.add_row(*(_text(row.get(name)) for name in names))
    console.print(table)


def _text(value: object) -> str:
    """Four digits of a number; nothing for None."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(map(_text, value))
    return "" if value is None else str(value)
