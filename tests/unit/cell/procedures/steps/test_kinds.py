"""A sequence per job: its steps as data, one more of them from outside, and what a script does in between."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cell.procedures.arm.photograph import BoardFix
from cell.procedures.steps import kinds
from cell.procedures.steps.kinds import PLACE, Kind, find_kind
from cell.procedures.steps.place import PlaceResult
from cell.procedures.steps.workplace import JobStep, Workplace
from drivers.clock import Clock
from drivers.errors import ConfigError
from statemachine.journal import Journal, read
from statemachine.runner import NO_SCRIPT, Again, Runner, RunResult, Script, StepContext
from statemachine.sequence import Sequence
from statemachine.step import Failure, Outcome, Policy, Step


@dataclass(frozen=True)
class Tilt:
    """How far a board leans, rad."""

    angle: float


def tilt(here: Workplace, context: StepContext) -> Tilt:
    rotation = context.made(BoardFix).base_from_board.rotation
    return Tilt(float(1.0 - abs(rotation[2, 2])))


LEAN = JobStep(Step("see_lean", 5.0, on_wall=True), tilt, Tilt, needs=(BoardFix,))
LOOK = PLACE.with_step(LEAN, after="board_photo", name="look_and_place")


def test_one_more_step_is_one_step_and_one_line() -> None:
    assert LOOK.names == ("drive_to_target", "board_photo", "see_lean", *PLACE.names[2:])
    assert LOOK.sequence().success == "placed"
    assert LOOK.policy().of("see_lean").deadline_s == 5.0
    only_look = LOOK.until("see_lean")
    assert only_look.names == ("drive_to_target", "board_photo", "see_lean")
    assert only_look.sequence().success == "done"


def test_a_step_whose_input_nobody_makes_is_refused() -> None:
    with pytest.raises(ValueError, match="step see_lean needs BoardFix, which no step before it makes"):
        PLACE.with_step(LEAN, after="drive_to_target", name="too_early")


def test_kinds_of_other_packages_are_found_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
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
    with pytest.raises(ConfigError, match="installed: broken, look_and_place, number, place"):
        find_kind("lunch")


def test_a_step_that_does_not_exist_is_named_with_those_that_do() -> None:
    with pytest.raises(ConfigError, match=r"no step lunch; the steps are drive_to_target, .*place"):
        PLACE.until("lunch")


def test_a_step_finds_what_it_needs_by_type() -> None:
    context = StepContext(Step("see", 1.0), 1, 1.0, {"a": Tilt(0.1), "b": 7, "c": Tilt(0.2)}, Clock(), print)
    assert context.made(Tilt) == Tilt(0.2)
    assert context.made(int) == 7
    with pytest.raises(LookupError, match="see needs a PlaceResult, which none of a, b, c made"):
        context.made(PlaceResult)


@dataclass(frozen=True)
class Leaning(Tilt):
    """A tilt that is one all the same."""


@dataclass(frozen=True, eq=False)
class Placed(PlaceResult):
    """How another package places."""


def test_what_a_step_makes_serves_whoever_needs_a_base_of_it() -> None:
    lean = JobStep(Step("see_lean", 5.0), tilt, Leaning)
    use = JobStep(Step("use_lean", 5.0), tilt, Placed, needs=(Tilt,))
    assert Kind("leaning", (lean, use)).sequence().success == "placed"


def test_a_step_that_made_something_else_has_failed() -> None:
    site = cast(Any, SimpleNamespace())
    gate = SimpleNamespace(entered=nullcontext)
    site.devices = SimpleNamespace(gate=gate, interlocks=SimpleNamespace(work_with=print))
    site.calibration, site.mover = SimpleNamespace(configuration=""), SimpleNamespace()
    site.frames = SimpleNamespace(begin=print)
    work = Kind("promising", (JobStep(Step("see", 5.0), lambda here, context: 7, Tilt),)).work(site)["see"]
    with pytest.raises(TypeError, match="step see made a int, not the Tilt it promises"):
        work(StepContext(Step("see", 5.0), 1, 5.0, {}, Clock(), print))


def test_a_kind_that_ends_the_program_as_it_is_loaded_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ends_the_program.py").write_text("import sys\nsys.exit(3)\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    installed = [EntryPoint("ends", "ends_the_program:KIND", kinds.GROUP)]
    monkeypatch.setattr(kinds, "entry_points", lambda group: installed)
    with pytest.raises(ConfigError, match="ends_the_program:KIND cannot be used: 3"):
        find_kind("ends")


class Bench:
    """Three steps, the second, or another, refuses as often as it is told to."""

    def __init__(self, folder: Path, refusals: int, script: Script = NO_SCRIPT, refuses: str = "sweep") -> None:
        self.log: list[str] = []
        self.seen: list[tuple[str, ...]] = []
        """Whose results each try was given."""
        self.refuses = refuses
        self.folder = folder
        names = ("photo", "sweep", "place")
        self.runner = Runner(
            sequence=Sequence(names),
            steps={name: self._step(name) for name in names},
            policy=Policy(tuple(Step(name, 5.0) for name in names)),
            journal=Journal(folder, "r1"),
            clock=Clock(),
            classify=lambda error: Failure(Outcome.REFUSED, str(error), "refused"),
            safe_stop=lambda reason: self.log.append("stop"),
            script=script,
        )
        self.left = refusals

    def _step(self, name: str):  # type: ignore[no-untyped-def]
        def work(context: StepContext) -> str:
            self.log.append(name)
            self.seen.append(tuple(context.results))
            if name == self.refuses and self.left > 0:
                self.left -= 1
                raise ValueError("too few points")
            return f"made by {name}"

        return work

    def run(self) -> RunResult:
        return self.runner.run()


def test_a_script_lets_a_refused_run_go_on_from_an_earlier_step_and_the_reason_is_kept(tmp_path: Path) -> None:
    asked: list[tuple[str, str]] = []

    def decide(step: str, failure: Failure) -> Again | None:
        asked.append((step, failure.reason))
        return Again("photo", "wiped the lens")

    bench = Bench(tmp_path, 1, Script(on_refusal=decide))
    result = bench.run()
    assert result.outcome is Outcome.PLACED
    assert asked == [("sweep", "too few points")]
    assert bench.log == ["photo", "sweep", "stop", "stop", "photo", "sweep", "place", "stop"]
    assert [(fault.step, fault.remedy) for fault in result.faults] == [("sweep", "again from photo")]
    (decided,) = (event for event in read(tmp_path).events if event.kind == "decided")
    assert decided.data == {"reason": "too few points", "again": "photo", "why": "wiped the lens"}


def test_what_is_to_be_done_again_is_given_nothing_of_what_came_after_it(tmp_path: Path) -> None:
    script = Script(on_refusal=lambda step, failure: Again("photo", "the table was bumped"))
    bench = Bench(tmp_path, 1, script, refuses="place")
    assert bench.run().outcome is Outcome.PLACED
    once = [(), ("photo",), ("photo", "sweep")]
    assert bench.seen == [*once, *once]


def test_a_script_is_asked_about_refusals_alone(tmp_path: Path) -> None:
    asked: list[str] = []

    def decide(step: str, failure: Failure) -> Again:
        asked.append(step)
        return Again("photo", "whatever it was")

    bench = Bench(tmp_path, 1, Script(on_refusal=decide))
    bench.runner.classify = lambda error: Failure(Outcome.FAULTED, str(error), "fault")
    assert bench.run().outcome is Outcome.FAULTED
    assert asked == []


def test_without_a_decision_a_refusal_ends_the_run(tmp_path: Path) -> None:
    result = Bench(tmp_path, 1, Script(on_refusal=lambda step, failure: None)).run()
    assert (result.outcome, result.reason) == (Outcome.REFUSED, "too few points")
    assert [fault.remedy for fault in result.faults] == ["ended the run"]


def test_a_decision_for_a_step_that_was_not_reached_ends_the_run(tmp_path: Path) -> None:
    result = Bench(tmp_path, 1, Script(on_refusal=lambda step, failure: Again("place", "hurry"))).run()
    assert result.outcome is Outcome.REFUSED
    assert "chose to go on from 'place', allowed: photo, sweep" in result.reason


def test_a_script_that_never_gives_up_is_asked_three_times_about_a_step(tmp_path: Path) -> None:
    asked: list[str] = []

    def decide(step: str, failure: Failure) -> Again:
        asked.append(step)
        return Again("photo", "once more")

    result = Bench(tmp_path, 99, Script(on_refusal=decide)).run()
    assert asked == ["sweep"] * 3
    assert result.outcome is Outcome.REFUSED
    assert "has decided about sweep 3 times, the most allowed" in result.reason


def test_retries_before_a_decision_are_counted_with_those_after_it(tmp_path: Path) -> None:
    bench = Bench(tmp_path, 5, Script(on_refusal=lambda step, failure: Again("sweep", "once more")))
    bench.runner.policy = bench.runner.policy.with_step(Step("sweep", 5.0, 1, ("ValueError",)))
    result = bench.run()
    assert result.outcome is Outcome.PLACED
    # Failed, retried; again: failed, retried; again: failed, retried, done.
    assert [record.retries for record in result.steps] == [0, 3, 0]
    assert [(fault.attempt, fault.remedy) for fault in result.faults] == [
        (1, "tried again"), (2, "again from sweep"), (1, "tried again"), (2, "again from sweep"), (1, "tried again"),
    ]  # fmt: skip


def test_a_script_sees_each_result_before_the_next_step_and_may_refuse(tmp_path: Path) -> None:
    seen: list[object] = []

    def look(result: object) -> None:
        seen.append(result)
        raise ValueError("the photograph is not of this board")

    bench = Bench(tmp_path, 0, Script(after={"photo": look}))
    result = bench.run()
    assert seen == ["made by photo"]
    assert (result.outcome, result.reason) == (Outcome.REFUSED, "the photograph is not of this board")
    assert set(bench.log[1:]) == {"stop"}


def test_an_abort_ends_a_run_whose_script_still_ponders(tmp_path: Path) -> None:
    bench = Bench(tmp_path, 0)

    def ponder(result: object) -> None:
        bench.runner.control.abort("enough")
        bench.runner.control.token.event.wait(5.0)
        bench.runner.control.token.check()

    bench.runner.script = Script(after={"photo": ponder})
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.ABORTED, "enough")
    assert "sweep" not in bench.log
