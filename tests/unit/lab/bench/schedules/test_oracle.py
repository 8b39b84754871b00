"""The oracle sees each violation, on a world that is driven by hand: the devices without the cell's gate."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.devices.simulated.direct import VirtualCell
from lab.bench.schedules.oracle import Oracle, RunEnd

CONFIG = load_config(None)
LASER, CLAW = 0, 1


@pytest.fixture
def cell() -> VirtualCell:
    made = VirtualCell(CONFIG, 2)
    assert (made.world.scene.drawing.cell.laser_output, made.world.scene.drawing.cell.claw_output) == (LASER, CLAW)
    return made


@pytest.fixture
def oracle(cell: VirtualCell) -> Iterator[Oracle]:
    made = Oracle(cell.world, cell.scan_camera.model, "nominal")

    def ring() -> float:
        made.tick()
        return 0.0

    with cell.clock.alarm(0.0, ring):
        cell.clock.sleep(0.1)
        yield made


def rules(oracle: Oracle) -> set[str]:
    return {violation.rule for violation in oracle.violations}


def drive(cell: VirtualCell) -> None:
    cell.vehicle.enable()
    cell.vehicle.drive(0.2, 0.0)


def turn(cell: VirtualCell) -> None:
    joints = cell.arm.state().joints.copy()
    joints[5] += 0.3
    cell.arm.move_joints(joints, 0.5, 1.0).wait(5.0)


def shine(cell: VirtualCell) -> None:
    cell.arm.set_digital_output(LASER, True)


def end(outcome: str = "faulted", reason: str = "", part: str | None = None, bound: float | None = None) -> RunEnd:
    return RunEnd(outcome, reason, part, tolerance=0.6e-3, bound=bound)


def test_a_cell_that_works_as_it_should_breaks_no_rule(cell: VirtualCell, oracle: Oracle):
    turn(cell)
    drive(cell)
    cell.clock.sleep(0.5)
    cell.vehicle.brake()
    shine(cell)
    for _ in range(3):
        cell.scan_camera.grab()
    cell.arm.set_digital_output(LASER, False)
    oracle.did("arm.emergency_stop")
    oracle.stopped()
    oracle.ended(end(reason="arm: the emergency stop is pressed"))
    cell.clock.sleep(1.0)
    assert oracle.violations == []


@pytest.mark.parametrize(("act", "rule"), [(turn, "arm and vehicle"), (shine, "laser")])
def test_an_arm_that_moves_or_a_laser_that_shines_while_the_vehicle_drives(
    cell: VirtualCell, oracle: Oracle, act: Callable[[VirtualCell], None], rule: str
):
    drive(cell)
    act(cell)
    assert rules(oracle) == {rule}


def test_a_laser_that_shines_for_nobody(cell: VirtualCell, oracle: Oracle):
    shine(cell)
    cell.clock.sleep(0.5)
    assert rules(oracle) == set()
    cell.clock.sleep(2.5)
    assert rules(oracle) == {"laser"}


def test_two_bodies_that_met(cell: VirtualCell, oracle: Oracle):
    cell.world.collisions.note(cell.clock.now(), "forearm", "board")
    cell.clock.sleep(0.1)
    assert [str(each) for each in oracle.violations] == ["touch at 0.15 s: forearm met board"]


@pytest.mark.parametrize(("held", "force", "broken"), [(True, 40.0, False), (True, 90.0, True), (False, 2.0, True)])
def test_too_much_force(cell: VirtualCell, oracle: Oracle, monkeypatch, held: bool, force: float, broken: bool):
    if not held:
        oracle.did("part_taken")
        cell.world.part.take_away()
    monkeypatch.setattr(cell.world.part, "wrench", lambda pose: np.array([0.0, 0.0, force, 0.0, 0.0, 0.0]))
    cell.world.collisions.note = lambda *_: None  # type: ignore[method-assign]
    cell.clock.sleep(0.1)
    assert (rules(oracle) == {"force"}) is broken


@pytest.mark.parametrize(
    ("what", "act"), [("arm", turn), ("vehicle", drive), ("rail", lambda cell: cell.rail.home()), ("laser", shine)]
)
def test_something_that_goes_on_after_the_end(
    cell: VirtualCell, oracle: Oracle, what: str, act: Callable[[VirtualCell], None]
):
    oracle.stopped()
    cell.clock.sleep(0.6)
    act(cell)
    cell.clock.sleep(0.5)
    assert rules(oracle) == {"after the end"}
    assert what in oracle.violations[0].how


def test_a_part_that_is_let_go_in_the_air(cell: VirtualCell, oracle: Oracle):
    cell.arm.set_digital_output(CLAW, False)
    assert rules(oracle) == {"let go in the air"}
    assert oracle.put_down


def test_a_part_that_a_person_takes_is_not_let_go(cell: VirtualCell, oracle: Oracle):
    oracle.did("part_taken")
    cell.world.part.take_away()
    cell.clock.sleep(0.1)
    assert rules(oracle) == set()
    assert not oracle.put_down


def test_a_resume_of_what_was_put_down(cell: VirtualCell, oracle: Oracle):
    oracle.resumed()
    assert rules(oracle) == set()
    cell.arm.set_digital_output(CLAW, False)
    oracle.resumed()
    assert "done twice" in rules(oracle)


def test_a_run_with_its_part_in_the_claw_that_is_not_resumed(oracle: Oracle):
    oracle.unresumed("its journal is damaged", torn=True)
    oracle.unresumed("it ended while the claw was releasing or gripping its part", torn=False)
    assert rules(oracle) == set()
    oracle.unresumed("for no reason", torn=False)
    assert rules(oracle) == {"forgotten"}


def test_a_journal_that_lags_behind_the_claw(cell: VirtualCell, oracle: Oracle):
    cell.arm.set_digital_output(CLAW, False)
    oracle.violations.clear()
    oracle.stopped()
    oracle.unresumed("it ended while the claw was releasing or gripping its part", torn=False)
    assert rules(oracle) == set()
    cell.clock.sleep(1.0)
    oracle.stopped()
    oracle.begun()
    oracle.unresumed("it ended while the claw was releasing or gripping its part", torn=False)
    assert rules(oracle) == {"journal"}


def test_a_journal_that_tells_otherwise_than_the_world(oracle: Oracle):
    oracle.did("abort")
    for part in (None, "held", "unknown"):
        oracle.ended(end("aborted", "a day's abort", part))
    assert rules(oracle) == set()
    oracle.ended(end("aborted", "a day's abort", "released"))
    assert rules(oracle) == {"journal"}


def test_an_end_that_names_no_cause_that_was_there(oracle: Oracle):
    oracle.did("rail.reset")
    oracle.ended(end("faulted", "rail: the module has lost its zero"))
    assert rules(oracle) == set()
    oracle.ended(end("refused", "the claw lost the part"))
    assert rules(oracle) == {"cause"}


def test_a_part_that_is_called_placed_and_is_not(cell: VirtualCell, oracle: Oracle):
    oracle.ended(end("placed", part="held"))
    assert rules(oracle) == {"placed"}


@pytest.mark.parametrize(
    ("off", "bound", "broken"), [(0.3e-3, None, set()), (0.3e-3, 0.1e-3, {"bound"}), (0.9e-3, None, {"placed"})]
)
def test_a_part_that_lies_beside_its_place(
    cell: VirtualCell, oracle: Oracle, off: float, bound: float | None, broken: set[str]
):
    oracle.taken = True
    pose = cell.world.scene.world_from_surface.copy()
    pose[:3, 3] += pose[:3, 0] * off
    cell.world.part._world_from_part = pose
    assert oracle.part_off() == pytest.approx(off, rel=1e-6)
    oracle.ended(end("placed", part="released", bound=bound))
    assert rules(oracle) == broken


@pytest.mark.parametrize("act", ["rail.reset", "surface_moved"])
def test_what_is_pushed_as_the_part_comes_down_is_nobodys_fault(cell: VirtualCell, oracle: Oracle, act: str):
    oracle.did(act)
    cell.arm.set_digital_output(CLAW, False)
    oracle.ended(end("placed", part="released"))
    assert ("placed" in rules(oracle)) is (act == "rail.reset")
