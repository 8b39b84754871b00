"""The fewest entries, and the simplest, by which a schedule still breaks the same rule."""

from collections.abc import Callable, Iterator
from dataclasses import replace

from lab.bench.schedules.schedule import Entry, Schedule

Breaks = Callable[[Schedule], bool]
"""Whether a schedule breaks the rule that is looked for."""
MOST_TRIES = 20


def shrunk(schedule: Schedule, breaks: Breaks, tries: int = MOST_TRIES) -> Schedule:
    """`schedule` breaks the rule; the smallest that was found within so many `tries` and still does."""
    going = True
    while going:
        going = False
        for smaller in simpler(schedule):
            if tries == 0:
                return schedule
            tries -= 1
            if breaks(smaller):
                schedule, going = smaller, True
                break
    return schedule


def simpler(schedule: Schedule) -> Iterator[Schedule]:
    """Each schedule that is one step simpler: an entry less, one that comes at the beginning or at half its instant,
    without what happens meanwhile, or of half its size; an undisturbed kind of world last."""
    for number in range(len(schedule.entries)):
        yield schedule.without(number)
    for number, entry in enumerate(schedule.entries):
        for other in _simpler(entry):
            if other != entry:
                entries = (*schedule.entries[:number], other, *schedule.entries[number + 1 :])
                yield replace(schedule, entries=entries)
    if schedule.level != "nominal":
        yield replace(schedule, level="nominal")


def _simpler(entry: Entry) -> Iterator[Entry]:
    if entry.meanwhile:
        yield replace(entry, meanwhile="")
    if entry.share:
        yield replace(entry, share=0.0)
    if entry.share > 0.05:
        yield replace(entry, share=round(0.5 * entry.share, 2))
    if abs(entry.amount) > 1.0:
        yield replace(entry, amount=float(round(0.5 * entry.amount)))
