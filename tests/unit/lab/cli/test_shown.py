"""How the laboratory's commands show results: every value once, under its own name."""

import json

import pytest
import typer

from lab.cli.shown import show

RESULT = {
    "seeds": 20,
    "place_mm": {"mean": 0.07213, "limit": None},
    "rows": [{"kind": "dots", "found": 1.0}, {"kind": "tags", "found": 0.9876}],
    "trials": [{"seed": 1}],
}


def test_people_see_values_and_records_without_what_is_too_long(capsys):
    show(RESULT, json=False, without=("trials",))
    lines = capsys.readouterr().out.splitlines()
    shown = [[cell.strip() for cell in line.strip("│").split("│")] for line in lines if line.startswith("│")]
    assert shown == [
        ["seeds", "20"], ["place_mm mean", "0.07213"], ["place_mm limit", ""], ["dots", "1"], ["tags", "0.9876"],
    ]  # fmt: skip


def test_scripts_get_all_of_it(capsys):
    show(RESULT, json=True, without=("trials",))
    assert json.loads(capsys.readouterr().out) == RESULT


def test_a_bench_that_failed_ends_with_1_after_it_was_shown(capsys):
    with pytest.raises(typer.Exit) as ended:
        show({"worlds": 3}, json=True, failed=["a violation"])
    assert (ended.value.exit_code, json.loads(capsys.readouterr().out)) == (1, {"worlds": 3})
