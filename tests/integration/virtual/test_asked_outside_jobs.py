"""Work outside a job asks a person after a protective stop, as a job does; then it goes on or ends."""

import json
import math
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell import Cell
from cell.apps.console.host.controller import ConsoleController
from cell.apps.console.view.run_view import RunView
from cell.devices.simulated.direct import VirtualCell
from cell.motion.kinematics import HOME
from cell.run import calibration as sessions
from cell.run.jogging import Jog, jog
from cell.run.runs import Run
from drivers.errors import Aborted, CellError, DeviceFault, InterlockError, RefusedError
from sim_backends.models.arm import Safety
from tests.support import Typed, until


@pytest.fixture
def cell(here: Path) -> Iterator[Cell]:
    with Cell.open(sim="all", seed=3, clock="virtual") as opened:
        yield opened


def simulated(cell: Cell) -> VirtualCell:
    assert isinstance(cell.simulated, VirtualCell)
    return cell.simulated


def stop_on_the_way(cell: Cell, times: int = 1) -> None:
    """The arm goes into protective stop as soon as it moves, this often."""
    arm, left = simulated(cell).arm, [times]
    before = arm.after_tick

    def after(t: float) -> None:
        before(t)
        if left[0] and arm.model.safety is Safety.NORMAL and np.abs(arm.model.drive.qd).max() > 0.05:
            left[0] -= 1
            arm.model.fault("protective_stop")

    arm.after_tick = after  # type: ignore[method-assign]


def asked(cell: Cell) -> Run[Any]:
    """The run that waits for a person."""
    assert until(lambda: (run := cell.current) is not None and run.control.question is not None)
    return cell.current  # type: ignore[return-value]


def in_background(work: Callable[[], object]) -> tuple[threading.Thread, list[object]]:
    """The thread that does it, and what became of it."""
    ended: list[object] = []

    def perform() -> None:
        try:
            ended.append(work())
        except (Aborted, CellError) as error:
            ended.append(error)

    thread = threading.Thread(target=perform, daemon=True)
    thread.start()
    return thread, ended


AWAY = HOME + np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("kind", ["calibration", "verification", "timing", "commission", "homing", "jog"])
@pytest.mark.parametrize("answer", ["confirm", "abort"])
def test_a_protective_stop_is_asked_about_and_the_work_goes_on_or_ends(cell: Cell, kind: str, answer: str):
    simulated(cell).devices.vehicle.brake()
    stop_on_the_way(cell)
    attempts: list[None] = []

    def work(context: Any) -> str:
        attempts.append(None)
        cell.mover(None, context.safe_point).to_joints(AWAY)
        return "made"

    thread, ended = in_background(lambda: cell.perform(kind, work))
    run = asked(cell)
    assert "protective stop" in run.control.question[1]  # type: ignore[index]
    arm = simulated(cell).arm.model
    assert (arm.safety, arm.moving) == (Safety.PROTECTIVE_STOP, False)
    run.confirm("the test") if answer == "confirm" else run.abort("not today")
    thread.join(60.0)
    report = json.loads((cell.runs_folder / run.folder.name / "report.json").read_text())  # type: ignore[union-attr]
    if answer == "confirm":
        assert (ended, len(attempts), report["outcome"]) == (["made"], 2, "done")
        assert np.abs(arm.drive.q - AWAY).max() < 1e-3
        # The stop of the first attempt keeps nobody from going on.
        assert cell.devices.gate.is_open
    else:
        assert isinstance(ended[0], Aborted) and "not today" in str(ended[0])
        assert (len(attempts), report["outcome"], arm.safety) == (1, "aborted", Safety.PROTECTIVE_STOP)
    assert not arm.moving


def test_a_fault_that_is_met_again_and_again_ends_the_work(cell: Cell):
    simulated(cell).devices.vehicle.brake()
    stop_on_the_way(cell, 9)
    thread, ended = in_background(lambda: cell.home("arm"))
    for number in range(1, 4):
        assert until(lambda number=number: asked(cell).confirm("the test", number))  # type: ignore[misc]
    thread.join(60.0)
    assert isinstance(ended[0], DeviceFault) and ended[0].code == "arm.protective_stop"


def test_a_jog_that_was_stopped_goes_on_to_its_goal_and_no_further(cell: Cell):
    before = simulated(cell).arm.model.drive.q[0]
    stop_on_the_way(cell)
    thread, ended = in_background(lambda: jog(cell, Jog("arm", "j1", math.radians(10.0))))
    asked(cell).confirm("the test")
    thread.join(60.0)
    assert isinstance(ended[0], dict)
    assert simulated(cell).arm.model.drive.q[0] - before == pytest.approx(math.radians(10.0), abs=1e-3)


def test_manual_mode_asks_at_the_desk_takes_no_step_meanwhile_and_goes_on(cell: Cell):
    controller = ConsoleController(cell, "pot", lambda client, words: None)
    controller.holders.joined("c1")
    controller.do("c1", {"do": "hold", "name": "Ann"})
    controller.do("c1", {"do": "manual", "on": True})
    step = {"do": "jog_step", "device": "arm", "axis": "z", "amount": 0.01}
    stop_on_the_way(cell)
    with pytest.raises(DeviceFault, match="protective stop"):
        controller.do("c1", step)
    number, _ = asked(cell).control.question or (0, "")
    with pytest.raises(InterlockError, match="answer the question first"):
        controller.do("c1", step)
    controller.do("c1", {"do": "decide", "number": number, "choice": "confirm", "reason": "the way is clear"})
    assert until(lambda: (run := cell.current) is not None and run.control.question is None)
    assert until(lambda: simulated(cell).arm.model.safety is Safety.NORMAL)
    before = cell.devices.arm.state().flange[2]

    def stepped() -> bool:
        try:
            return controller.do("c1", step)["ok"] is True
        except Aborted:
            return False  # asked for before manual mode had begun anew: dropped, not done later

    assert until(stepped)
    assert cell.devices.arm.state().flange[2] - before == pytest.approx(0.01, abs=1e-4)
    controller.close()


def test_an_arm_that_stopped_while_nothing_runs_is_unlocked_by_a_person_alone(cell: Cell):
    controller = ConsoleController(cell, "pot", lambda client, words: None)
    controller.holders.joined("c1")
    simulated(cell).fault("arm.protective_stop")
    with pytest.raises(InterlockError, match="does not hold it"):
        controller.do("c1", {"do": "recover"})
    with pytest.raises(CellError, match="the name of the person"):
        cell.recover(" ")
    assert simulated(cell).arm.model.safety is Safety.PROTECTIVE_STOP
    controller.do("c1", {"do": "hold", "name": "Ann"})
    controller.do("c1", {"do": "recover"})
    assert until(lambda: cell.current is None)
    assert simulated(cell).arm.model.safety is Safety.NORMAL
    (folder,) = cell.runs_folder.iterdir()
    report = json.loads((folder / "report.json").read_text())
    assert (report["kind"], report["outcome"], report["by"]) == ("recovery", "done", "Ann")
    # What only the arm's own button clears is not cleared here.
    simulated(cell).fault("arm.emergency_stop")
    with pytest.raises(DeviceFault, match="emergency stop"):
        cell.recover("Ann")


def test_a_pendant_that_is_switched_to_local_refuses_the_next_motion_of_a_job(cell: Cell):
    """Connected in remote control: what was asked there holds for no later motion."""
    simulated(cell).devices.vehicle.brake()
    cell.home("arm")
    simulated(cell).fault("arm.local_control")
    with pytest.raises(DeviceFault, match="in local control") as caught:
        cell.perform("homing", lambda context: cell.mover(None, context.safe_point).to_joints(AWAY))
    assert caught.value.code == "arm.local_control"
    assert np.abs(simulated(cell).arm.model.drive.q - HOME).max() < 1e-3


def test_a_job_whose_first_calibration_fails_ends_as_any_run(cell: Cell, monkeypatch, typed: Typed):
    def refuse(*arguments: object) -> None:
        raise RefusedError("3 of 20 calibration views show the board")

    monkeypatch.setattr(sessions, "collect_scan", refuse)
    run = cell.start("pot")
    assert run.result(60.0).exit_code == 1
    view = RunView(run, (), "pot", {})
    view.news()
    assert view.ended is not None and (view.ended["kind"], view.ended["outcome"]) == ("job", "refused")
    cell.close()
    code, out, _ = typed("dry-run", "--clock", "virtual", "--seed", "3")
    said = " ".join(out.split())
    assert (code, said.split()[0]) == (1, "refused")
    assert "in the calibration before the job: 3 of 20 calibration views show the board" in said
    assert "put that right, then cell dry-run --seed 3 --clock virtual -j pot" in said
