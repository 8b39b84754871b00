"""What the arm driver's child makes of the arm's states, with states that are written down here and no arm."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from cell.run.recorded_work import classify
from drivers.arm.child import program
from drivers.arm.child.program import ControlProgram, joints_off
from drivers.arm.feed import ChildSetup, Snapshot
from drivers.errors import Aborted, CalibrationStale, ConfigError, DeadlineError, DeviceFault, LimitError, RefusedError
from statemachine.step import Outcome

SETUP = ChildSetup("127.255.0.9", 1.0, (), (0.0, (0.0, 0.0, 0.0)), 0.15, 4.0)
STILL = (0.0,) * 6


class Library:
    """In place of the vendor's control interface: it takes everything, and counts."""

    def __init__(self) -> None:
        self.kicks = self.stops = 0
        self.runs = True

    def kickWatchdog(self) -> None:
        self.kicks += 1

    def stopJ(self, braking: float, wait: bool) -> None:
        self.stops += 1

    def isProgramRunning(self) -> bool:
        return self.runs

    def getAsyncOperationProgressEx(self) -> Any:
        return SimpleNamespace(operationId=lambda: 7, isAsyncOperationRunning=lambda: True)


class Arm:
    """What the arm tells: `state`, renewed at each look unless it is `silent`."""

    def __init__(self) -> None:
        self.state = Snapshot(time.monotonic(), STILL, STILL, STILL, STILL, 1, 7, 2, 0, 0)
        self.silent = False
        self.library = Library()
        self.program = ControlProgram(SETUP, self.library, self.latest)

    def latest(self) -> Snapshot:
        if not self.silent:
            self.state = replace(self.state, stamp=time.monotonic())
        return self.state

    def shows(self, **changed: Any) -> None:
        self.state = replace(self.state, **changed)


@pytest.fixture
def arm(monkeypatch) -> Arm:
    monkeypatch.setattr(program, "SETTLE_S", 0.1)
    monkeypatch.setattr(program, "BRAKING_S", 0.1)
    return Arm()


def near(snapshot: Snapshot) -> str:
    return joints_off(snapshot, STILL, "its target")


def test_a_motion_has_arrived_when_the_arm_has_stood_at_its_target_for_a_moment(arm: Arm):
    begun = time.monotonic()
    assert arm.program.settled(near) == ("arrived", "")
    assert time.monotonic() - begun >= 0.02


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("off", [0.0025, -0.0025])
def test_a_joint_beside_the_target_is_told_with_how_far(arm: Arm, joint: int, off: float):
    aside = tuple(off * (k == joint) for k in range(6))
    arm.shows(joints=aside)
    how, text = arm.program.settled(near)
    assert (how, text) == ("arm.not_arrived", "a joint is 0.143 deg off its target")


def test_an_arm_that_does_not_come_to_rest_at_its_target_has_not_arrived(arm: Arm):
    arm.shows(speeds=(0.0, 0.0, -0.01, 0.0, 0.0, 0.0))
    assert arm.program.settled(near) == ("arm.not_arrived", "the arm does not come to rest")


def test_states_from_before_tell_of_no_arrival(arm: Arm):
    arm.silent = True
    assert arm.program.settled(near)[0] == "arm.not_arrived"


def test_the_watchdog_is_kept_quiet_only_while_the_arm_is_heard_and_its_program_runs(arm: Arm):
    """Else a pulled cable would not stop it."""
    arm.program.kick()
    assert arm.library.kicks == 1
    arm.program.kick()
    assert arm.library.kicks == 1, "not more often than needed"
    time.sleep(program.KICK_S)
    arm.silent = True
    arm.shows(stamp=time.monotonic() - 0.75 * SETUP.watchdog)
    arm.program.kick()
    assert arm.library.kicks == 1
    arm.silent = False
    for runtime in (1, 3, 4):
        arm.shows(runtime=runtime)
        arm.program.kick()
    assert arm.library.kicks == 1
    arm.shows(runtime=2)
    arm.program.kick()
    assert arm.library.kicks == 2


@pytest.mark.parametrize(
    ("shown", "code"),
    [
        ({}, None),
        ({"safety_bits": 1 << 2}, "arm.protective_stop"),
        ({"safety_bits": 1 << 2, "mode": 3}, "arm.protective_stop"),
        ({"safety_bits": 1 << 6}, "arm.emergency_stop"),
        ({"mode": 5}, "arm.not_powered"),
    ],
)
def test_what_keeps_the_arm_from_moving_is_named(arm: Arm, shown: dict[str, int], code: str | None):
    arm.shows(**shown)
    problem = arm.program.problem()
    assert (problem[0] if problem else None) == code


def test_a_program_that_has_ended_is_told_with_its_cause_though_that_comes_later(arm: Arm):
    arm.library.runs = False
    threading.Timer(0.03, lambda: arm.shows(safety_bits=1 << 2)).start()
    assert arm.program.problem() == ("arm.protective_stop", "")
    arm.shows(safety_bits=1, runtime=4)
    assert arm.program.problem() == ("arm.program_stopped", "it was paused at the arm")
    assert ControlProgram(SETUP, None, arm.latest).problem() == ("arm.program_stopped", "")


def test_an_arm_has_been_stopped_when_it_shows_rest_after_it_was_told(arm: Arm):
    assert arm.program.brake() is None
    assert arm.library.stops == 1
    arm.silent = True  # the rest that it showed is from before
    stopped = arm.program.brake()
    assert stopped is not None
    assert stopped[0] == "arm.not_stopped"


@pytest.mark.parametrize(
    "moving",
    [
        {"speeds": (0.0, 0.1, 0.0, 0.0, 0.0, 0.0)},
        {"speeds": (0.0, -0.1, 0.0, 0.0, 0.0, 0.0), "runtime": 1},
        {"runtime": 4},
    ],
    ids=["moves", "moves though its program has ended", "paused"],
)
def test_an_arm_that_goes_on_or_may_go_on_is_not_stopped(arm: Arm, moving: dict[str, Any]):
    arm.shows(**moving)
    stopped = arm.program.brake()
    assert stopped is not None
    assert stopped[0] == "arm.not_stopped"


@pytest.mark.parametrize(
    ("error", "outcome", "recoverable", "person"),
    [
        (RefusedError("no"), Outcome.REFUSED, False, False),
        (CalibrationStale("old"), Outcome.REFUSED, False, False),
        (ConfigError("wrong"), Outcome.REFUSED, False, False),
        (Aborted("stopped"), Outcome.ABORTED, False, False),
        (DeadlineError("arm", "late"), Outcome.FAULTED, False, False),
        (LimitError("arm", "too far"), Outcome.FAULTED, False, False),
        (ZeroDivisionError("unforeseen"), Outcome.FAULTED, False, False),
        (DeviceFault("arm", "arm.protective_stop", "", recoverable=True, hint=""), Outcome.FAULTED, True, True),
        (DeviceFault("arm", "arm.program_stopped", "", recoverable=True, hint=""), Outcome.FAULTED, True, False),
        (DeviceFault("arm", "arm.emergency_stop", "", recoverable=False, hint=""), Outcome.FAULTED, False, False),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)
def test_what_an_error_means_for_a_run(error: Exception, outcome: Outcome, recoverable: bool, person: bool):
    failure = classify(error)
    assert (failure.outcome, failure.recoverable, failure.needs_person) == (outcome, recoverable, person)
