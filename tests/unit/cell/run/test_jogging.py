"""What may be typed after `cell jog`."""

import math
from types import SimpleNamespace

import pytest

from cell.run.jogging import Jog, begin_program, needed_for, parse_jog
from drivers.errors import ConfigError, DeviceFault
from drivers.interfaces import ArmSafety


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["rail", "+5mm"], Jog("rail", "", 0.005)),
        (["arm", "z", "-10mm"], Jog("arm", "z", -0.01)),
        (["arm", "j3", "+5deg"], Jog("arm", "j3", math.radians(5))),
        (["arm", "rx", "2", "deg"], Jog("arm", "rx", math.radians(2))),
        (["vehicle", "+0.1m"], Jog("vehicle", "x", 0.1)),
        (["vehicle", "-5deg"], Jog("vehicle", "yaw", math.radians(-5))),
    ],
)
def test_a_jog_is_read_with_its_unit(words: list[str], expected: Jog):
    wish = parse_jog(words[0], words[1:])
    assert (wish.device, wish.axis) == (expected.device, expected.axis)
    assert wish.amount == pytest.approx(expected.amount)


@pytest.mark.parametrize(
    "words",
    [["rail", "5"], ["rail"], ["arm", "+5mm"], ["arm", "j7", "5deg"], ["arm", "z", "5deg"], ["laser", "1mm"],
     ["rail", "+2m"], ["vehicle", "+5"], ["arm", "j3", "+5mm"], ["rail", "+5kg"], ["rail", "nanmm"],
     ["rail", "+5mm^9^9"], ["arm", "q", "5mm"], ["tower", "5mm"], ["rail", "-501mm"], ["vehicle", "+0.51m"],
     ["vehicle", "-0.51m"], ["arm", "x", "501mm"], ["arm", "j1", "-91deg"], ["vehicle", "91deg"]],
)  # fmt: skip
def test_anything_else_is_refused_with_examples(words: list[str]):
    with pytest.raises(ConfigError, match="write it like"):
        parse_jog(words[0], words[1:])


def test_arm_and_vehicle_are_jogged_beside_each_other_unless_a_person_lifts_that():
    arm, vehicle, rail = Jog("arm", "z", 0.01), Jog("vehicle", "x", 0.1), Jog("rail", "", 0.01)
    assert (needed_for(arm), needed_for(vehicle), needed_for(rail)) == (
        ("arm", "vehicle"), ("vehicle", "arm"), ("rail",),
    )  # fmt: skip
    assert needed_for(arm, ["vehicle_parked"]) == ("arm",)
    assert needed_for(arm, ["arm_stowed"]) == ("arm", "vehicle")
    assert needed_for(vehicle, ["arm_stowed"]) == ("vehicle",)


@pytest.mark.parametrize(
    ("code", "controlled", "safety", "recovered"),
    [
        ("arm.link_lost", True, ArmSafety.NORMAL, True),
        ("arm.link_closed", True, ArmSafety.NORMAL, True),
        ("arm.wrong_model", True, ArmSafety.NORMAL, None),
        ("", True, ArmSafety.NORMAL, False),
        ("", False, ArmSafety.NORMAL, True),
        ("", True, ArmSafety.PROTECTIVE_STOP, True),
    ],
)
def test_the_program_begins_anew_only_where_it_has_ended(
    code: str, controlled: bool, safety: ArmSafety, recovered: bool | None
):
    """`recovered` is None where another fault of the arm is passed on."""
    called: list[bool] = []

    def state() -> SimpleNamespace:
        if code:
            raise DeviceFault("arm", code, "as the test has it", recoverable=True, hint="")
        return SimpleNamespace(controlled=controlled, safety=safety)

    arm = SimpleNamespace(state=state, recover=lambda: called.append(True))
    if recovered is None:
        with pytest.raises(DeviceFault, match="as the test has it"):
            begin_program(arm)  # type: ignore[arg-type]
    else:
        begin_program(arm)  # type: ignore[arg-type]
    assert bool(called) == bool(recovered)
