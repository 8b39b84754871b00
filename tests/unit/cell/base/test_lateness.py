"""A computer that wakes up late is noticed while somebody asks, and a person is told before a run begins."""

import pytest

from cell.base import lateness
from cell.base.lateness import Lateness, busy_words


def test_late_naps_count_only_while_somebody_measures():
    measured = Lateness()
    measured._late.extend([0.001] * 90 + [0.02] * 9 + [0.3])
    assert (measured.worst, measured.usual) == (0.0, 0.0)
    measured._users = 1
    assert (measured.worst, measured.usual) == (0.3, 0.02)


def test_the_last_user_ends_it_and_the_next_begins_anew():
    measured = Lateness()
    measured.begin(3.0)
    measured.begin(2.0)
    first = measured._over
    measured.end()
    assert (measured.rate, first.is_set()) == (2.0, False)
    measured.end()
    assert first.is_set()
    measured._late.append(9.0)
    measured.begin()
    assert measured.worst < 9.0
    measured.end()


@pytest.mark.parametrize(("late", "words"), [(0.008, None), (0.009, "wakes up 9 ms late, allowed 8 ms")])
def test_a_busy_computer_is_told_with_its_figure(late: float, words: str | None, monkeypatch):
    measured = Lateness()
    measured._users = 1
    measured._late.append(late)
    monkeypatch.setattr(lateness, "LATENESS", measured)
    told = busy_words()
    assert told is None if words is None else told is not None and words in told
