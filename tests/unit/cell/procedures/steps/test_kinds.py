"""A sequence per job: its steps as data, and one more of them from outside."""

from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cell.config.job import load_job
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.steps import kinds
from cell.procedures.steps.kinds import BUILT_IN, PLACE, Kind, find_kind, kind_of
from cell.procedures.steps.place import PlaceResult
from cell.procedures.steps.workplace import JobStep, Workplace
from drivers.clock import Clock
from drivers.errors import ConfigError
from statemachine.runner import StepContext
from statemachine.sequence import JobState, JobTrigger, Sequence, SequenceError, Transition, TransitionGuard
from statemachine.step import Step


@dataclass(frozen=True)
class Tilt:
    """How far a board leans, rad."""

    angle: float


def tilt(workplace: Workplace, context: StepContext) -> Tilt:
    rotation = context.made(BoardFix).base_from_board.rotation
    return Tilt(float(1.0 - abs(rotation[2, 2])))


LEAN = JobStep(Step("see_lean", 5.0, on_wall=True), tilt, Tilt, needs=(BoardFix,))
LOOK = PLACE.with_step(LEAN, after="board_photo", name="look_and_place")


@pytest.mark.parametrize(("job", "sees"), [("shell", True), ("load", True), ("pot", False), ("unload", False)])
def test_where_the_placed_part_is_seen_on_its_surface_a_bumped_head_shows(job: str, sees: bool):
    assert kind_of(load_job(job)[0]).sees_place == sees


def test_one_more_step_is_one_step_and_one_line():
    assert LOOK.names == ("drive_to_target", "board_photo", "see_lean", *PLACE.names[2:])
    assert (LOOK.sequence().success, LOOK.policy().of("see_lean").deadline_s) == ("placed", 5.0)
    only_look = LOOK.until("see_lean")
    assert only_look.names == ("drive_to_target", "board_photo", "see_lean")
    assert only_look.sequence().success == "done"


def test_a_step_whose_input_nobody_makes_is_refused():
    with pytest.raises(ValueError, match="step see_lean needs BoardFix, which no step before it makes"):
        PLACE.with_step(LEAN, after="drive_to_target", name="too_early")


def test_kinds_of_other_packages_are_found_by_name(monkeypatch):
    installed = [
        EntryPoint("look_and_place", f"{__name__}:LOOK", kinds.GROUP),
        EntryPoint("place", f"{__name__}:LOOK", kinds.GROUP),
        EntryPoint("broken", "no_such_package:KIND", kinds.GROUP),
        EntryPoint("number", "math:pi", kinds.GROUP),
    ]
    monkeypatch.setattr(kinds, "entry_points", lambda group: installed)
    assert find_kind("look_and_place") is LOOK
    assert find_kind("place") is PLACE, "a foreign kind must not shadow the one that ships"
    with pytest.raises(ConfigError, match="no_such_package:KIND cannot be used"):
        find_kind("broken")
    with pytest.raises(ConfigError, match="is a float, no kind of job"):
        find_kind("number")
    with pytest.raises(ConfigError, match="installed: broken, load, look_and_place, number, place"):
        find_kind("lunch")


def test_a_step_that_does_not_exist_is_named_with_those_that_do():
    with pytest.raises(ConfigError, match=r"no step lunch; the steps are drive_to_target, .*place"):
        PLACE.until("lunch")


def test_a_step_finds_what_it_needs_by_type():
    context = StepContext(Step("see", 1.0), 1, 1.0, {"a": Tilt(0.1), "b": 7, "c": Tilt(0.2)}, Clock(), print)
    assert (context.made(Tilt), context.made(int)) == (Tilt(0.2), 7)
    with pytest.raises(LookupError, match="see needs a PlaceResult, which none of a, b, c made"):
        context.made(PlaceResult)


@dataclass(frozen=True)
class Leaning(Tilt):
    """A tilt that is one all the same."""


@dataclass(frozen=True, eq=False)
class Placed(PlaceResult):
    """How another package places."""


def test_what_a_step_makes_serves_whoever_needs_a_base_of_it():
    lean = JobStep(Step("see_lean", 5.0), tilt, Leaning)
    use = JobStep(Step("use_lean", 5.0), tilt, Placed, needs=(Tilt,))
    assert Kind("leaning", (lean, use)).sequence().success == "placed"


def test_a_step_that_made_something_else_has_failed():
    site = cast(Any, SimpleNamespace(needs_part=False, retried=False, held=None))
    gate = SimpleNamespace(entered=nullcontext)
    site.devices = SimpleNamespace(gate=gate, interlocks=SimpleNamespace(work_with=print))
    site.calibration, site.mover = SimpleNamespace(configuration=""), SimpleNamespace()
    site.frames = SimpleNamespace(begin=print)
    work = Kind("promising", (JobStep(Step("see", 5.0), lambda workplace, context: 7, Tilt),)).work(site)["see"]
    with pytest.raises(TypeError, match="step see made a int, not the Tilt it promises"):
        work(StepContext(Step("see", 5.0), 1, 5.0, {}, Clock(), print))


def test_a_kind_that_ends_the_program_as_it_is_loaded_is_refused(tmp_path, monkeypatch):
    (tmp_path / "ends_the_program.py").write_text("import sys\nsys.exit(3)\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    installed = [EntryPoint("ends", "ends_the_program:KIND", kinds.GROUP)]
    monkeypatch.setattr(kinds, "entry_points", lambda group: installed)
    with pytest.raises(ConfigError, match="ends_the_program:KIND cannot be used: 3"):
        find_kind("ends")


ENDS = (JobState.REFUSED, JobState.MISPLACED, JobState.ABORTED, JobState.PLACED, JobState.DONE)
ALL_KINDS = {**BUILT_IN, "place and verify": kind_of(load_job("shell")[0]), "until": PLACE.until("board_photo")}


def allow(sequence: Sequence, row: Transition) -> None:
    """Make the guard of a transition hold, and nothing else."""
    facts = sequence.facts
    match row.guard:
        case TransitionGuard.DONE:
            facts.done.add(row.source)
        case TransitionGuard.RETRIES_LEFT:
            facts.retries_left = 1
        case TransitionGuard.RECOVERABLE:
            facts.recoverable, facts.retries_left, facts.interrupted = True, 1, sequence.steps[0]
        case TransitionGuard.INTERRUPTED:
            facts.interrupted = row.target
        case TransitionGuard.CHOSEN:
            facts.chosen = row.target


def taken(kind: Kind, path: tuple[Transition, ...]) -> Sequence:
    """The kind's sequence after these transitions, each of which leads where the table says."""
    sequence = kind.sequence()
    for row in path:
        allow(sequence, row)
        assert sequence.fire(row.trigger) == row.target
    return sequence


def ways(kind: Kind) -> dict[str, tuple[Transition, ...]]:
    """A way to each state that can be reached, the shortest, along the sequence's own transitions."""
    found: dict[str, tuple[Transition, ...]] = {JobState.IDLE: ()}
    waiting: list[str] = [JobState.IDLE]
    while waiting:
        state = waiting.pop(0)
        for row in kind.sequence().table:
            if row.source == state and row.target not in found:
                found[row.target] = (*found[state], row)
                waiting.append(row.target)
    return found


@pytest.mark.parametrize("name", ALL_KINDS)
def test_of_each_kind_every_transition_is_legal_where_it_stands_and_no_other(name: str):
    kind = ALL_KINDS[name]
    found, rows = ways(kind), kind.sequence().table
    assert set(found) == {row.source for row in rows}, "a state that nothing leads to"
    for state, way in found.items():
        for row in (row for row in rows if row.source == state):
            taken(kind, (*way, row))
        for trigger in set(JobTrigger) - {row.trigger for row in rows if row.source == state}:
            with pytest.raises(SequenceError, match="leads nowhere"):
                taken(kind, way).fire(trigger)


@pytest.mark.parametrize("name", ALL_KINDS)
def test_of_each_kind_no_state_is_a_dead_end_and_each_can_be_aborted_and_fail(name: str):
    kind = ALL_KINDS[name]
    sequence = kind.sequence()
    for state, way in ways(kind).items():
        assert taken(kind, way).fire(JobTrigger.FAULT) == JobState.FAULTED
        assert taken(kind, way).fire(JobTrigger.ABORT) == JobState.ABORTED
        reached, before = {state}, set[str]()
        while reached != before:
            before = set(reached)
            outside = (JobTrigger.FAULT, JobTrigger.ABORT)
            reached |= {row.target for row in sequence.table if row.source in before and row.trigger not in outside}
        assert state in ENDS or sequence.success in reached, f"from {state} the job cannot be finished"
