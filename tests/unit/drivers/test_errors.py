"""What is done at the end of a piece of work is done, and does not hide why the work ended."""

import pytest

from drivers.errors import DeadlineError, DeviceFault, InterlockError, in_the_end

FAULT = DeviceFault("arm", "arm.emergency_stop", "emergency stop", recoverable=False, hint="Release it.")


def silent() -> None:
    raise DeadlineError("camera", "no answer to 'stop'")


def test_the_first_error_goes_on_and_tells_of_the_second():
    with pytest.raises(DeviceFault) as caught, in_the_end(silent):
        raise FAULT
    assert caught.value is FAULT
    assert "no answer to 'stop'" in "".join(caught.value.__notes__)


def test_an_end_that_fails_after_work_that_went_well_is_an_error():
    with pytest.raises(DeadlineError), in_the_end(silent):
        pass


@pytest.mark.parametrize("error", [None, InterlockError("rail", "no"), KeyboardInterrupt()])
def test_the_end_comes_once_whatever_happened(error: BaseException | None):
    done: list[str] = []
    try:
        with in_the_end(lambda: done.append("off")):
            if error is not None:
                raise error
    except BaseException as caught:
        assert caught is error
    assert done == ["off"]
