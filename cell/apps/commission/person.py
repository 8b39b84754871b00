"""Whoever stands beside the cell: confirms what is to move, says what sensors cannot see, lends a hand.

At a simulated cell its own person may answer: what one would see there is known, and hands can be had.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class Person(Protocol):
    """Someone beside the cell."""

    def go_ahead(self, text: str) -> bool:
        """Whether what `text` announces may begin."""

    def sees(self, question: str) -> bool:
        """Yes or no to a question about what there is to be seen."""

    def again(self, question: str) -> bool:
        """Whether something was changed meanwhile and is to be measured again."""

    def does(self, task: str, by_itself: Callable[[], None] | None = None) -> bool:
        """Have a person do something; False if they would not. A simulated person does it as `by_itself` says."""


class PersonAtTheConsole:
    """Asks on the console; `ask` shows a text and gives yes or no."""

    def __init__(self, ask: Callable[[str], bool]) -> None:
        self._ask = ask

    def go_ahead(self, text: str) -> bool:
        """See `Person.go_ahead`."""
        return self._ask(f"{text}\n  A hand on the emergency stop. Go ahead?")

    def sees(self, question: str) -> bool:
        """See `Person.sees`."""
        return self._ask(question)

    def again(self, question: str) -> bool:
        """See `Person.again`."""
        return self._ask(question)

    def does(self, task: str, by_itself: Callable[[], None] | None = None) -> bool:
        """See `Person.does`."""
        return self._ask(f"{task} Done?")


class SimulatedPerson:
    """Of a simulated cell: agrees to everything, and says so through `tell`."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell

    def go_ahead(self, text: str) -> bool:
        """See `Person.go_ahead`."""
        self._tell(f"{text} (simulated person: go ahead)")
        return True

    def sees(self, question: str) -> bool:
        """See `Person.sees`."""
        self._tell(f"{question} (simulated person: yes)")
        return True

    def again(self, question: str) -> bool:
        """See `Person.again`: nobody has changed anything."""
        return False

    def does(self, task: str, by_itself: Callable[[], None] | None = None) -> bool:
        """See `Person.does`."""
        self._tell(f"{task} (simulated person: done)")
        if by_itself is not None:
            by_itself()
        return True
