"""Promises of `statemachine.step`."""

import pytest

from statemachine.step import Policy, Step


def test_a_retry_is_for_the_named_errors_and_those_that_derive_from_them():
    step = Step("any", 1.0, 1, ("OSError",))
    assert step.retries(OSError()) and step.retries(ConnectionResetError())
    assert not step.retries(ValueError()) and not step.retries(Exception())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"name": "place", "deadline_s": 0.0}, "must be greater than 0 s"),
        ({"name": "place", "deadline_s": 1.0, "max_retries": -1}, "must be 0 or more"),
    ],
)
def test_a_wrong_step_policy_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Step(**values)


def test_a_policy_names_every_step_once():
    photo, place = Step("board_photo", 1.0), Step("place", 1.0)
    with pytest.raises(ValueError, match="each step once"):
        Policy((photo, photo))
    assert Policy((photo, place)).of("place") == place
