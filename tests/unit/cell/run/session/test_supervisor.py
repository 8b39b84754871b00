"""What a person may say of a cell: that a stop is over, which rules a maintenance lifts; and what that leaves."""

import json
import logging
import os
from collections.abc import Iterator

import numpy as np
import pinocchio as pin
import pytest

from cell.config.job import job_path
from cell.devices.lock import CellLock
from cell.measure.geometry.poses import from_ur
from cell.motion.kinematics import HOME
from cell.run.jogging import jog, parse_jog
from cell.run.session.session import OpenCell
from cell.run.session.supervisor import Cell
from drivers.errors import Aborted, ConfigError, InterlockError
from tests.unit.cell.devices.gate.test_interlocks import CONFIG, LASER, at_rest, refused
from tests.unit.drivers.vehicle.test_agilex import Bench


@pytest.fixture
def cell(tmp_path) -> Iterator[Cell]:
    made = Cell(OpenCell(CONFIG, tmp_path, CellLock(CONFIG), at_rest().devices, None))
    yield made
    made.close()


def test_after_a_stop_a_script_begins_nothing_until_a_person_says_so(cell: Cell):
    rail, arm = cell.devices.rail, cell.devices.arm
    rail.move_to(0.01).wait(30.0)
    cell.stop()
    for begin in (
        lambda: rail.move_to(0.02), rail.home, lambda: arm.move_joints(HOME + 0.01, 0.5, 1.0), arm.recover,
        cell.devices.vehicle.enable, cell.devices.claw.grip, arm.zero_force, lambda: arm.set_payload(1.0, np.zeros(3)),
        lambda: arm.set_digital_output(7, True),
    ):  # fmt: skip
        refused("after_a_stop", begin, "clear_stop(by)")
    arm.set_digital_output(LASER, False)
    cell.home("rail")
    refused("after_a_stop", lambda: rail.move_to(0.02))
    with pytest.raises(ConfigError, match="name of the person"):
        cell.clear_stop(" ")
    cell.clear_stop("Anna")
    rail.move_to(0.02).wait(30.0)
    assert rail.state().position == pytest.approx(0.02, abs=1e-6)


def test_an_output_that_may_be_the_lasers_is_switched_off_by_a_stop_and_after_it_while_it_is_tried(cell: Cell):
    """Where the numbers of laser and claw are swapped in the configuration, the claw's output lights the laser."""
    arm, claw = cell.devices.arm, CONFIG.claw.output
    with cell.maintenance("what hangs on which output", ["own_switch"]), cell.devices.interlocks.tried(claw):
        arm.set_digital_output(claw, True)
        cell.stop()
        assert not arm.state().digital_outputs >> claw & 1
        arm.bare.set_digital_output(claw, True)
        arm.set_digital_output(claw, False)
        assert not arm.state().digital_outputs >> claw & 1
    refused("after_a_stop", lambda: arm.set_digital_output(7, False), "clear_stop(by)")


def test_an_output_that_is_tried_counts_as_a_lasers_for_the_arm_as_well(cell: Cell):
    """A recovery switches off what may be a laser's, and leaves a claw's alone otherwise."""
    arm, claw = cell.devices.arm, CONFIG.claw.output
    with cell.maintenance("what hangs on which output", ["own_switch"]):
        arm.set_digital_output(claw, True)
        arm.recover()
        assert arm.state().digital_outputs >> claw & 1
        with cell.devices.interlocks.tried(claw):
            arm.recover()
            assert not arm.state().digital_outputs >> claw & 1


class ReadSlowly(os.PathLike[str]):
    """A job's file that is read so slowly that a stop comes meanwhile."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell

    def __fspath__(self) -> str:
        self.cell.stop()
        return str(job_path("pot"))


def test_a_stop_that_comes_while_work_is_prepared_is_not_lost(cell: Cell):
    stood = cell.devices.arm.state().joints
    for begin in (lambda job: cell.calibrate(job=job), lambda job: jog(cell, parse_jog("arm", ["j1", "+5deg"]), job)):
        with pytest.raises(Aborted, match=r"was stopped before the .* began"):
            begin(ReadSlowly(cell))
    before = cell.stops
    cell.stop()
    with pytest.raises(Aborted, match="was stopped before the test began"):
        cell.perform("test", lambda context: None, stops=before)
    assert np.array_equal(cell.devices.arm.state().joints, stood)


def test_work_outside_a_job_takes_the_vehicle_in_command_with_its_brake_locked(cell: Cell):
    assert not cell.devices.vehicle.state().command_mode
    cell.home("arm")
    state = cell.devices.vehicle.state()
    assert (state.command_mode, state.braked) == (True, True)


def test_a_recovery_opens_the_vehicles_bus_again(cell: Cell, monkeypatch):
    bench = Bench("recovery")
    try:
        monkeypatch.setattr(cell.devices, "_vehicle", bench.vehicle)
        bench.vehicle._link._fail("the cable was out")
        cell.recover("Anna")
        assert bench.vehicle.state().braked
    finally:
        bench.vehicle.close()
        bench.peer.stop()


def test_maintenance_lifts_what_it_names_and_nothing_else_and_is_recorded(cell: Cell, caplog):
    devices, away = cell.devices, HOME + 0.05
    devices.vehicle.enable()
    with caplog.at_level(logging.WARNING), cell.maintenance("the brake is being changed", lift=["vehicle_parked"]):
        devices.arm.move_joints(away, 0.5, 1.0).wait(30.0)
        refused("claw_at_contact", devices.claw.release)
    assert "maintenance (the brake is being changed): lifted vehicle_parked" in caplog.text
    refused("vehicle_parked", lambda: devices.arm.move_joints(HOME, 0.5, 1.0))
    (report,) = (json.loads(path.read_text()) for path in cell.runs_folder.glob("*/report.json"))
    assert (report["kind"], report["outcome"]) == ("maintenance", "done")
    assert (report["maintenance"], report["lifted"]) == ("the brake is being changed", ["vehicle_parked"])


def test_a_run_in_maintenance_says_so_in_its_report(cell: Cell):
    with cell.maintenance("trial", lift=["own_switch"]):
        cell.home("rail")
    reports = [json.loads(path.read_text()) for path in cell.runs_folder.glob("*/report.json")]
    assert {report["kind"]: report.get("interlocks_lifted") for report in reports}["homing"] == ["own_switch"]


@pytest.mark.parametrize(
    "names", [["no_such_rule"], ["after_a_stop"], ["laser_attended"], ["way_clear", "same_kinematics"], []]
)
def test_only_rules_that_a_person_may_lift_are_lifted_and_only_for_a_reason(cell: Cell, names: list[str]):
    with pytest.raises(ConfigError), cell.maintenance("why not", lift=names):
        pass
    with pytest.raises(ConfigError, match="needs a reason"), cell.maintenance(" ", lift=["own_switch"]):
        pass
    assert not list(cell.runs_folder.glob("*/report.json"))


def test_jogs_keep_the_interlocks_and_home_makes_the_vehicle_free_to_drive(cell: Cell):
    def jogged(device: str, *words: str) -> dict[str, str]:
        return jog(cell, parse_jog(device, list(words)))

    assert "moved" in jogged("vehicle", "+0.1m")["vehicle"]
    assert cell.devices.vehicle.state().braked
    assert "→" in jogged("arm", "j1", "+20deg")["j1"]
    with pytest.raises(InterlockError, match=r"20\.0 deg from HOME.*cell home arm.*arm_stowed"):
        jogged("vehicle", "+0.1m")
    cell.home("arm")
    jogged("vehicle", "-0.1m")
    moved = jogged("arm", "z", "+10mm")["flange"].split("moved ")[1]
    assert float(moved.removesuffix(" mm")) == pytest.approx(10.0, abs=0.1)


@pytest.mark.parametrize(("axis", "turn"), [("rx", (0.05, 0.0, 0.0)), ("rz", (0.0, 0.0, -0.05))])
def test_a_jog_turns_the_flange_about_an_axis_of_the_base_where_it_stands(
    cell: Cell, axis: str, turn: tuple[float, ...]
):
    before = from_ur(cell.devices.arm.state().flange)
    jog(cell, parse_jog("arm", [axis, f"{sum(turn)} rad"]))
    after = from_ur(cell.devices.arm.state().flange)
    np.testing.assert_allclose(pin.log3(after.rotation @ before.rotation.T), turn, atol=1e-3)
    np.testing.assert_allclose(after.translation, before.translation, atol=1e-4)
