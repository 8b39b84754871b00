"""Each cause stops what moves or shines in a simulated cell, and a stop that comes late is measured."""

from contextlib import closing

import pytest

from cell.apps.commission.check import Result
from cell.apps.commission.checks import stops
from cell.apps.commission.checks.stops import MOST_S, MOST_WAY
from cell.apps.commission.sequence import by_name
from drivers.interfaces import ArmState
from tests.support.commissioning import Shown, files, opened


@pytest.mark.parametrize("late_s", [0.0, 1.5])
def test_time_and_way_until_rest_are_measured_for_each_cause(tmp_path, monkeypatch, late_s: float):
    files(tmp_path)
    made, result = opened(tmp_path, Shown()), Result()
    with closing(made.workplace):
        cell, stop = made.workplace.cell, made.workplace.cell.stop
        monkeypatch.setattr(cell, "stop", lambda: (cell.devices.clock.sleep(late_s), stop()))
        by_name("stops").work(made.workplace, result)
    rows = {row.what: row for row in result.readings}
    for name in ("rail", "arm", "vehicle"):
        for cause in ("Cell.stop()", "`cell abort`"):
            time, way = rows[f"{name}, {cause}: time to rest, at most"], rows[f"{name}, {cause}: way"]
            assert (time.most, way.most) == (MOST_S, MOST_WAY[name])
            assert time.ok is not (late_s > 0.0 and cause == "Cell.stop()")
    late = {row.what for row in rows.values() if not row.ok}
    assert late >= {"rail, Cell.stop(): time to rest, at most", "laser, Cell.stop(): off after, at most"} or not late_s
    assert result.verdict == ("wrong" if late_s else "good")


@pytest.mark.parametrize("pressed", [True, False])
def test_a_person_has_the_time_in_which_joint_1_turns_to_press_the_button(tmp_path, monkeypatch, pressed: bool):
    files(tmp_path)
    asked: list[str] = []
    made, result = opened(tmp_path, Shown(), lambda text: asked.append(text) is None), Result()
    with closing(made.workplace):
        work, arm = made.workplace, made.workplace.devices.arm
        work.fold()
        monkeypatch.setattr(work, "simulated", False)
        state, begun, presses = arm.state, work.devices.clock.now(), [1] * pressed

        def seen() -> ArmState:
            # Whoever was asked needs a few seconds.
            if presses and asked and work.devices.clock.now() - begun > 4.0:
                presses.pop()
                work.cause("arm.protective_stop")
            return state()

        monkeypatch.setattr(type(arm), "state", lambda self: seen())
        stops._emergency(work, result)
    assert any("press the emergency stop while it turns" in text for text in asked)
    assert (result.verdict == "good") is pressed
