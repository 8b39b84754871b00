"""Planted bugs can be planted: each stands once where it says, and the tests that it names exist."""

import re
from functools import cache

from tests.mutants.test_planted_bugs import BUGS
from tests.support import ROOT


@cache
def text(path: str) -> str:
    file = ROOT / path
    return file.read_text(encoding="utf-8") if file.is_file() else ""


def test_each_planted_bug_stands_once_in_its_file():
    assert [str(bug) for bug in BUGS if text(bug.file).count(bug.old) != 1 or bug.old == bug.new] == []


def test_each_test_that_is_to_notice_a_planted_bug_exists():
    def exists(test: str) -> bool:
        # What is in a class may be inherited from another file.
        path, name, *_ = (*test.split("::"), "")
        return (
            bool(text(path)) and re.search(rf"(def|class) {re.escape(name.partition('[')[0])}", text(path)) is not None
        )

    assert [test for bug in BUGS for test in bug.tests if not exists(test)] == []


def test_no_two_planted_bugs_have_one_name():
    names = [str(bug) for bug in BUGS]
    assert [name for name in names if names.count(name) > 1] == []
