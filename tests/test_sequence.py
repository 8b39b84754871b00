"""The sequence: order, guards, and the two ways out of every state."""

from __future__ import annotations

import re

import pytest

from statemachine.diagram import mermaid
from statemachine.policy import Policy, Step
from statemachine.sequence import ENDS, STEPS, TRANSITIONS, Sequence, SequenceError, State, Trigger

ORDER = ["drive_to_target", "board_photo", "laser_sweep", "reconstruct", "invert_pose", "place"]


def at(state: State) -> Sequence:
    """A sequence that was led to `state` along its own transitions."""
    sequence = Sequence()
    if state is State.IDLE:
        return sequence
    if state is State.REFUSED:
        sequence.fire(Trigger.REFUSE)
    elif state is State.ABORTED:
        sequence.fire(Trigger.ABORT)
    else:
        sequence.fire(Trigger.START)
    if state is State.PAUSED:
        sequence.fire(Trigger.PAUSE)
    elif state in (State.FAULTED, State.RECOVERING):
        sequence.fire(Trigger.FAULT)
    if state is State.RECOVERING:
        sequence.facts.recoverable, sequence.facts.retries_left = True, 1
        sequence.fire(Trigger.RECOVER)
    while sequence.state is not state and sequence.state in STEPS:
        sequence.facts.done.add(sequence.state)
        sequence.fire(Trigger.NEXT)
    assert sequence.state is state
    return sequence


def test_the_steps_follow_each_other_to_placed():
    sequence = Sequence()
    walked = [sequence.fire(Trigger.START).value]
    while sequence.state in STEPS:
        sequence.facts.done.add(sequence.state)
        walked.append(sequence.fire(Trigger.NEXT).value)
    assert walked == [*ORDER, "placed"]


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize(("trigger", "end"), [(Trigger.FAULT, State.FAULTED), (Trigger.ABORT, State.ABORTED)])
def test_fault_and_abort_lead_out_of_every_state(state, trigger, end):
    assert at(state).fire(trigger) is end


@pytest.mark.parametrize("step", STEPS)
def test_no_step_is_left_before_it_is_done(step):
    sequence = at(step)
    with pytest.raises(SequenceError, match=r"held back.*not done"):
        sequence.fire(Trigger.NEXT)
    assert sequence.state is step


def test_a_job_with_done_steps_starts_at_the_first_open_one():
    sequence = Sequence()
    sequence.facts.done |= {State.DRIVE_TO_TARGET, State.BOARD_PHOTO}
    assert sequence.fire(Trigger.START) is State.LASER_SWEEP


@pytest.mark.parametrize("step", STEPS)
def test_pause_and_recovery_come_back_to_the_step_they_left(step):
    sequence = at(step)
    sequence.fire(Trigger.PAUSE)
    assert sequence.fire(Trigger.RESUME) is step
    sequence.facts.recoverable, sequence.facts.retries_left = True, 1
    sequence.fire(Trigger.FAULT)
    sequence.fire(Trigger.RECOVER)
    assert sequence.fire(Trigger.RECOVERED) is step


@pytest.mark.parametrize(("recoverable", "retries"), [(False, 3), (True, 0)])
def test_recovery_needs_a_recoverable_fault_and_a_retry_left(recoverable, retries):
    sequence = at(State.LASER_SWEEP)
    sequence.fire(Trigger.FAULT)
    sequence.facts.recoverable, sequence.facts.retries_left = recoverable, retries
    with pytest.raises(SequenceError, match="held back"):
        sequence.fire(Trigger.RECOVER)


def test_a_trigger_that_leads_nowhere_is_an_error_that_names_both():
    with pytest.raises(SequenceError, match="'resume' leads nowhere from state 'idle'"):
        Sequence().fire(Trigger.RESUME)


@pytest.mark.parametrize("end", ENDS)
def test_every_end_can_be_reset_and_forgets_what_was_done(end):
    sequence = at(end)
    assert sequence.fire(Trigger.RESET) is State.IDLE
    assert sequence.fire(Trigger.START) is STEPS[0]


def test_changes_are_told_to_the_hook():
    told = []
    sequence = Sequence(on_change=lambda *change: told.append(change))
    sequence.fire(Trigger.START)
    assert told == [(Trigger.START, State.IDLE, State.DRIVE_TO_TARGET)]


def test_the_machine_holds_exactly_the_table():
    assert sorted(map(str, Sequence().rows())) == sorted(map(str, TRANSITIONS))


def test_the_diagram_shows_every_state_and_trigger():
    text = mermaid()
    edges = re.findall(r"(\S+) --> (\S+) : (\w+)", text)
    assert text.startswith("stateDiagram-v2\n")
    assert {trigger for *_, trigger in edges} == {trigger.value for trigger in Trigger}
    assert {name for edge in edges for name in edge[:2]} == {state.value for state in State} | {"job", "any_state"}
    assert ("any_state", "faulted", "fault") in edges
    assert ("any_state", "aborted", "abort") in edges


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"name": "lunch", "deadline_s": 1.0}, "'lunch' is unknown; the steps are drive_to_target"),
        ({"name": "place", "deadline_s": 0.0}, "must be greater than 0 s"),
        ({"name": "place", "deadline_s": 1.0, "max_retries": -1}, "must be 0 or more"),
    ],
)
def test_a_wrong_step_policy_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Step(**values)


def test_a_policy_names_every_step_once():
    with pytest.raises(ValueError, match="missing: \\['board_photo'"):
        Policy(steps=(Step("drive_to_target", 1.0),))
    changed = Policy().with_step(Step("place", 7.0))
    assert changed.of(State.PLACE).deadline_s == 7.0
    assert changed.of(State.BOARD_PHOTO) == Policy().of(State.BOARD_PHOTO)


def test_retries_go_by_the_name_of_the_exception_or_of_a_base_of_it():
    class Silent(TimeoutError):
        pass

    step = Step("board_photo", 1.0, 1, retry_on=("TimeoutError",))
    assert step.retries(Silent())
    assert not step.retries(ValueError())
