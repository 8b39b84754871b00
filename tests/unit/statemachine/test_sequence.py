"""The sequence: order, guards, and the two ways out of every state."""

import pytest

from statemachine.sequence import JobState, JobTrigger, Sequence, SequenceError

STEPS = ("drive_to_target", "board_photo", "laser_sweep", "reconstruct", "invert_pose", "place")
STATES = [state for state in JobState if state is not JobState.DONE]


WAYS = {
    JobState.IDLE: (), JobState.REFUSED: (JobTrigger.REFUSE,), JobState.ABORTED: (JobTrigger.ABORT,),
    JobState.PAUSED: (JobTrigger.START, JobTrigger.PAUSE), JobState.FAULTED: (JobTrigger.START, JobTrigger.FAULT),
    JobState.RECOVERING: (JobTrigger.START, JobTrigger.FAULT, JobTrigger.RECOVER),
    JobState.MISPLACED: (JobTrigger.START, JobTrigger.MISPLACE),
}  # fmt: skip


def at(state: str) -> Sequence:
    """A sequence that was led to `state` along its own transitions."""
    sequence = Sequence(STEPS)
    sequence.facts.recoverable, sequence.facts.retries_left = True, 1
    for trigger in WAYS.get(state, (JobTrigger.START,)):
        sequence.fire(trigger)
    while sequence.state != state and sequence.state in STEPS:
        sequence.facts.done.add(sequence.state)
        sequence.fire(JobTrigger.NEXT)
    assert sequence.state == state
    return sequence


def test_the_steps_follow_each_other_to_placed():
    sequence = Sequence(STEPS)
    walked = [sequence.fire(JobTrigger.START)]
    while sequence.state in STEPS:
        sequence.facts.done.add(sequence.state)
        walked.append(sequence.fire(JobTrigger.NEXT))
    assert walked == [*STEPS, "placed"]


@pytest.mark.parametrize("state", [*STATES, *STEPS])
@pytest.mark.parametrize(
    ("trigger", "end"), [(JobTrigger.FAULT, JobState.FAULTED), (JobTrigger.ABORT, JobState.ABORTED)]
)
def test_fault_and_abort_lead_out_of_every_state(state, trigger, end):
    assert at(state).fire(trigger) == end


@pytest.mark.parametrize("step", STEPS)
def test_no_step_is_left_before_it_is_done(step):
    sequence = at(step)
    with pytest.raises(SequenceError, match=r"held back.*not done"):
        sequence.fire(JobTrigger.NEXT)
    assert sequence.state == step


@pytest.mark.parametrize("step", STEPS)
def test_pause_and_recovery_come_back_to_the_step_they_left(step):
    sequence = at(step)
    sequence.fire(JobTrigger.PAUSE)
    assert sequence.fire(JobTrigger.RESUME) == step
    sequence.fire(JobTrigger.FAULT)
    sequence.fire(JobTrigger.RECOVER)
    assert sequence.fire(JobTrigger.RECOVERED) == step


@pytest.mark.parametrize(("recoverable", "retries"), [(False, 3), (True, 0)])
def test_recovery_needs_a_recoverable_fault_and_a_retry_left(recoverable, retries):
    sequence = at("laser_sweep")
    sequence.fire(JobTrigger.FAULT)
    sequence.facts.recoverable, sequence.facts.retries_left = recoverable, retries
    with pytest.raises(SequenceError, match="held back"):
        sequence.fire(JobTrigger.RECOVER)


def test_a_trigger_that_leads_nowhere_is_an_error_that_names_both():
    with pytest.raises(SequenceError, match="'resume' leads nowhere from state 'idle'"):
        Sequence(STEPS).fire(JobTrigger.RESUME)


def test_changes_are_told_to_the_hook():
    told = []
    sequence = Sequence(STEPS, on_change=lambda *change: told.append(change))
    sequence.fire(JobTrigger.START)
    assert told == [(JobTrigger.START, JobState.IDLE, "drive_to_target")]


@pytest.mark.parametrize("steps", [(), ("photo", "photo"), ("photo", "paused")])
def test_steps_have_names_of_their_own(steps):
    with pytest.raises(ValueError, match="names of their own"):
        Sequence(steps)


def test_a_chosen_step_is_done_again_with_all_that_follow_it():
    sequence = at("invert_pose")
    with pytest.raises(SequenceError, match=r"held back.*chosen step"):
        sequence.fire(JobTrigger.AGAIN)
    sequence.facts.chosen = "place"
    with pytest.raises(SequenceError, match="held back"):
        sequence.fire(JobTrigger.AGAIN)
    sequence.facts.chosen = "board_photo"
    assert (sequence.fire(JobTrigger.AGAIN), sequence.facts.done) == ("board_photo", {"drive_to_target"})
    assert sequence.facts.chosen is None
