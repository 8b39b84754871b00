"""Each interlock refuses what it is for, over the simulated world: with its name, what was found, what to do next."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait

import numpy as np
import pinocchio as pin
import pytest

from cell.config.cell_config import load_config
from cell.devices.devices import Devices
from cell.devices.gate.interlocks import DeviceCommand
from cell.devices.gate.rules import LINE_STEP_M, LINE_STEP_RAD, RULES, Ways, markdown
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_parts, from_ur, to_ur
from cell.motion.collision import BASE, FLANGE, block, tool_bodies
from cell.motion.kinematics import HOME
from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceFault, InterlockError, LimitError
from sim_backends.models.arm import Power
from sim_backends.models.arm_kinematics import Kinematics
from tests.support import ROOT

CONFIG = load_config(None)
LASER = CONFIG.laser.output
DOCUMENT = ROOT / "docs" / "reference" / "interlocks.md"


def at_rest() -> VirtualCell:
    """A simulated cell: the vehicle braked, the arm folded, the rail homed, a part in the claw."""
    made = VirtualCell(CONFIG, seed=4, level="ideal")
    made.vehicle.brake()
    made.arm.move_joints(HOME, 1.0, 2.0).wait(60.0)
    made.rail.home().wait(60.0)
    return made


world = pytest.fixture(at_rest, name="world")


@pytest.fixture
def devices(world: VirtualCell) -> Devices:
    return world.devices


def refused(rule: str, begin: Callable[[], object], *words: str) -> None:
    """`begin` is refused by that rule alone, in these words."""
    with pytest.raises(InterlockError) as caught:
        begin()
    for word in (f"interlock {rule}", *words):
        assert word in str(caught.value)


def shifted(devices: Devices, *by: float) -> np.ndarray:
    """The flange moved by so many m along the base's axes."""
    return to_ur(from_parts(by) * from_ur(devices.arm.state().flange))


def test_the_table_in_the_documents_is_current():
    assert markdown() in DOCUMENT.read_text(encoding="utf-8")


def test_every_rule_is_asked_for_commands_that_there_are(devices: Devices):
    for rule in RULES:
        for command in rule.commands:
            device, name = command.split(".")
            assert hasattr(getattr(devices, device), name), command


def test_the_arm_moves_only_while_the_vehicle_is_parked_and_braked(devices: Devices):
    devices.vehicle.enable()
    stood = devices.arm.state().joints
    away = HOME + 0.1
    refused("vehicle_parked", lambda: devices.arm.move_joints(away, 0.5, 1.0), "brake is open", "vehicle.brake()")
    refused("vehicle_parked", lambda: devices.arm.move_linear(shifted(devices, 0.0, 0.0, 0.01), 0.05, 0.5))
    refused("vehicle_parked", lambda: devices.arm.follow(np.array([0.0, 1.0]), np.array([stood, away])))
    with devices.interlocks.purpose("test"):
        refused("vehicle_parked", devices.laser.lit().__enter__)
    assert np.array_equal(devices.arm.state().joints, stood)
    devices.vehicle.brake()
    devices.arm.move_joints(away, 0.5, 1.0).wait(30.0)


def test_the_vehicle_drives_only_with_the_arm_at_rest_in_a_transport_pose(world: VirtualCell, devices: Devices):
    devices.vehicle.enable()
    devices.vehicle.drive(0.1, 0.0)
    devices.vehicle.brake()
    out = HOME + np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    motion = devices.arm.move_joints(out, 0.5, 1.0)
    world.clock.sleep(0.1)
    devices.vehicle.bare.enable()
    refused("arm_stowed", lambda: devices.vehicle.drive(0.1, 0.0), "the arm moves")
    motion.wait(30.0)
    refused("arm_stowed", lambda: devices.vehicle.drive(0.0, 0.1), "28.6 deg from HOME", "cell home arm")
    devices.vehicle.drive(0.0, 0.0)
    devices.interlocks.may_drive_with("the looking pose of job pot", from_ur(devices.arm.state().flange))
    devices.vehicle.drive(0.1, 0.0)
    devices.vehicle.brake()


def test_the_laser_is_lit_for_a_declared_purpose_only_and_not_while_driving(devices: Devices):
    refused("laser_purpose", devices.laser.lit().__enter__, "sweep, calibration, test")
    assert not devices.laser.is_on
    with pytest.raises(ConfigError, match="sweep, calibration, test"), devices.interlocks.purpose("show"):
        pass
    with devices.interlocks.purpose("test"), devices.laser.lit():
        assert devices.laser.is_on
        refused("laser_off_to_drive", devices.vehicle.enable, "the laser is on")
        devices.vehicle.bare.enable()
        refused("laser_off_to_drive", lambda: devices.vehicle.drive(0.1, 0.0), "the laser is on")
    assert not devices.laser.is_on


def test_an_alarm_on_the_wall_rings_whatever_its_owner_does_and_not_after_its_end():
    clock, rung = Clock(rate=100.0), []

    def ring() -> float | None:
        rung.append(clock.now())
        return 5.0 if len(rung) < 3 else None

    with clock.alarm(10.0, ring):
        clock.sleep(60.0)
    assert len(rung) == 3
    assert rung[0] >= 10.0
    with clock.alarm(20.0, ring):
        pass
    clock.sleep(40.0)
    assert len(rung) == 3


def test_the_claw_opens_at_contact_or_when_it_is_empty(world: VirtualCell, devices: Devices):
    refused("claw_at_contact", devices.claw.release, "the part would fall", "maintenance")
    assert devices.claw.holding
    devices.arm.move_joints(HOME + 0.02, 0.5, 1.0).wait(30.0)
    refused("claw_at_contact", devices.claw.release)
    devices.claw.bare.release()
    devices.claw.release()


def at_contact(world: VirtualCell, devices: Devices) -> None:
    """The arm's newest motion ends as the gripped part touches something, which pushes with 20 N."""
    devices.interlocks.work_with(CONFIG.calibration_hash())
    here, model = devices.arm.state().joints, world.arm.model
    motion = devices.arm.follow(np.array([0.0, 4.0]), np.array([here, here + 0.02]), force_limit=10.0)
    world.clock.sleep(1.0)
    free = model.contact
    model.contact = lambda flange: np.asarray(free(flange)) + np.array([0.0, 0.0, 20.0, 0.0, 0.0, 0.0])
    motion.wait(30.0)
    model.contact = free
    assert motion.contact


def test_the_claw_opens_where_contact_ended_and_not_once_the_arm_was_moved_from_there(
    world: VirtualCell, devices: Devices
):
    at_contact(world, devices)
    devices.arm.bare.move_joints(devices.arm.state().joints + 0.02, 0.5, 1.0).wait(30.0)
    refused("claw_at_contact", devices.claw.release, "1.15 deg since its motion ended at contact", "0.29 deg")
    assert devices.claw.holding
    at_contact(world, devices)
    devices.claw.release()
    assert not devices.claw.holding


def test_a_retreat_that_failed_as_it_began_leaves_no_contact_behind(world: VirtualCell, devices: Devices):
    at_contact(world, devices)
    bare = devices.arm.bare

    class CutAsItBegins:
        """The arm, whose link is lost once the request has gone out."""

        def __getattr__(self, name: str) -> object:
            return getattr(bare, name)

        def move_joints(self, *arguments: object) -> object:
            bare.move_joints(*arguments)
            raise DeviceFault("arm", "arm.link_lost", "the link is lost", recoverable=True, hint="Recover.")

    devices.arm.bare = CutAsItBegins()
    with pytest.raises(DeviceFault):
        devices.arm.move_joints(devices.arm.state().joints + 0.001, 0.5, 1.0)
    refused("claw_at_contact", devices.claw.release)
    assert devices.claw.holding


def test_the_way_of_a_path_is_known_while_the_arm_follows_it_and_of_no_other_motion(devices: Devices):
    stood, situation = devices.arm.state().joints, devices.interlocks.situation
    way = np.array([stood, stood + 0.001])
    devices.arm.follow(np.array([0.0, 1.0]), way).wait(30.0)
    np.testing.assert_array_equal(situation.way, way)
    devices.arm.move_joints(stood, 0.5, 1.0).wait(30.0)
    assert situation.way is None


def test_a_recovery_leaves_no_contact_behind(world: VirtualCell, devices: Devices):
    at_contact(world, devices)
    devices.arm.recover()
    refused("claw_at_contact", devices.claw.release)


def test_the_brake_opens_only_with_the_arm_at_rest_and_free(world: VirtualCell, devices: Devices):
    motion = devices.arm.move_joints(HOME + 0.3, 0.5, 1.0)
    world.clock.sleep(0.2)
    refused("arm_still", devices.vehicle.enable, "the arm moves")
    assert devices.vehicle.state().braked
    motion.wait(30.0)
    at_contact(world, devices)
    refused("arm_still", devices.vehicle.enable, "ended at contact", "Move it away")
    devices.arm.move_joints(HOME, 0.5, 1.0).wait(30.0)
    devices.vehicle.enable()


def test_two_commands_that_exclude_each_other_do_not_both_pass(devices: Devices):
    """While one is being begun the other one waits, and is checked against what the first one made."""
    gate, order = devices.gate, []
    inside, go_on = threading.Event(), threading.Event()

    def slowly() -> None:
        inside.set()
        go_on.wait(5)
        order.append("first begun")

    enable = DeviceCommand("vehicle", "enable")
    with ThreadPoolExecutor(2) as threads:
        threads.submit(gate.begin, enable, slowly, lambda: None)
        assert inside.wait(5)
        second = threads.submit(gate.begin, enable, lambda: order.append("second begun"), lambda: None)
        wait([second], 0.2)
        assert order == []
        go_on.set()
    assert order == ["first begun", "second begun"]


def test_a_stop_does_not_wait_for_what_is_being_begun(devices: Devices):
    inside, go_on, undone = threading.Event(), threading.Event(), threading.Event()

    def slowly() -> None:
        inside.set()
        go_on.wait(5)

    with ThreadPoolExecutor(1) as thread:
        begun = thread.submit(devices.gate.begin, DeviceCommand("vehicle", "enable"), slowly, undone.set)
        assert inside.wait(5)
        assert devices.stop() == []
        assert not begun.done()
        go_on.set()
        assert "after_a_stop" in str(begun.exception(5))
    assert undone.is_set()


def test_a_drive_that_is_refused_ends_the_velocity_before_it(world: VirtualCell, devices: Devices):
    devices.vehicle.enable()
    devices.vehicle.drive(0.1, 0.0)
    world.clock.sleep(0.1)
    assert devices.vehicle.state().speed > 0.0
    devices.arm.bare.move_joints(HOME + 0.2, 1.0, 2.0)
    world.clock.sleep(0.2)
    refused("arm_stowed", lambda: devices.vehicle.drive(0.1, 0.0), "the arm moves")
    world.clock.sleep(0.2)
    assert devices.vehicle.state().speed == 0.0


@pytest.mark.parametrize(
    "joints", [np.full(6, np.nan), np.full(6, 1e6), np.zeros(5), ["a"] * 6], ids=["nan", "far", "five", "words"]
)
def test_what_no_arm_can_be_asked_is_a_limit_before_anything_is_reckoned(devices: Devices, joints: object):
    arm, here = devices.arm, devices.arm.state().joints
    for begin in (
        lambda: arm.move_joints(joints, 0.5, 1.0),
        lambda: arm.move_linear(joints, 0.1, 0.5),
        lambda: arm.follow(np.array([0.0, 1.0]), [here, joints]),
        lambda: arm.follow(np.empty(0), np.empty((0, 6))),
    ):
        with pytest.raises(LimitError, match="nothing was sent"):
            begin()
    assert np.array_equal(arm.state().joints, here)


def test_what_rests_on_a_calibration_is_refused_without_one_that_fits(devices: Devices):
    devices.rail.move_to(devices.rail.sweep_start(0.02, 0.03, 0.015)).wait(30.0)
    here = devices.arm.state().joints

    def guarded() -> object:
        return devices.arm.follow(np.array([0.0, 1.0]), np.array([here, here]), force_limit=20.0)

    def sweep() -> object:
        return devices.rail.sweep(0.02, 0.03, 0.015)

    refused("calibration_fits", sweep, "no calibration is in use", "cell calibrate")
    refused("calibration_fits", guarded)
    devices.interlocks.work_with("0123456789abcdef")
    refused("calibration_fits", sweep, "0123456789abcdef", CONFIG.calibration_hash())
    devices.interlocks.work_with(CONFIG.calibration_hash())
    devices.rail.sweep(0.02, 0.03, 0.015).wait(30.0)
    devices.arm.follow(np.array([0.0, 1.0]), np.array([here, here])).wait(30.0)


def test_a_raw_move_into_the_cells_own_bodies_is_refused(world: VirtualCell, devices: Devices):
    stood = devices.arm.state()
    onto_the_deck = shifted(devices, -0.6, 0.2, -0.6)
    into_itself = HOME + np.array([0.0, 0.0, 1.55, 0.0, 0.0, 0.0])
    refused("way_clear", lambda: devices.arm.move_joints(into_itself, 0.5, 1.0), "would collide on the way", "plan it")
    refused("way_clear", lambda: devices.arm.follow(np.array([0.0, 9.0]), np.array([stood.joints, into_itself])))
    refused("way_clear", lambda: devices.arm.move_linear(onto_the_deck, 0.05, 0.5), "claw and deck")
    assert np.array_equal(devices.arm.state().joints, stood.joints)
    assert world.world.collisions.found == ()


@pytest.mark.parametrize("turn", [0.3, 0.0])
def test_a_straight_line_is_checked_all_the_way_in_even_steps_as_it_turns(turn: float):
    """Its poses lie on the line and turn evenly about one axis, no farther apart than a collision check may skip."""
    ways, shift = Ways(CONFIG), np.array([0.0, -0.03, 0.08])
    begin = ways.forward(HOME)
    goal = from_parts(begin.translation + shift, pin.exp3(np.array([0.0, turn, 0.0])) @ begin.rotation)
    command = DeviceCommand("arm", "move_linear", {"flange": to_ur(goal)})
    line = [ways.forward(joints) for joints in ways._way(HOME, command)]
    assert len(line) >= max(turn / LINE_STEP_RAD, np.linalg.norm(shift) / LINE_STEP_M)
    for k, pose in enumerate(line, start=1):
        share = k / len(line)
        np.testing.assert_allclose(pose.translation, begin.translation + share * shift, atol=1e-5)
        np.testing.assert_allclose(pin.log3(pose.rotation @ begin.rotation.T), [0.0, turn * share, 0.0], atol=1e-5)


def test_raw_moves_are_checked_against_the_station_until_the_vehicle_may_drive(devices: Devices):
    stood = devices.arm.state().joints
    down = shifted(devices, 0.0, 0.0, -0.05)
    tip = from_ur(devices.arm.state().flange) * from_parts((0.0, 0.0, 0.145))
    table = block("table", BASE, tip.translation - [0.3, 0.3, 0.2], tip.translation + np.array([0.3, 0.3, -0.03]))
    devices.interlocks.stand_before([table])
    refused("way_clear", lambda: devices.arm.move_linear(down, 0.05, 0.5), "claw and table")
    assert np.array_equal(devices.arm.state().joints, stood)
    devices.interlocks.carry(tool_bodies((0.07, 0.036, 0.025), from_parts((0.0, 0.0, 0.145)))[-1:])
    near = shifted(devices, 0.0, 0.0, -0.01)
    refused("way_clear", lambda: devices.arm.move_linear(near, 0.05, 0.5), "part and table")
    devices.vehicle.enable()
    devices.vehicle.brake()
    devices.arm.move_linear(down, 0.05, 0.5).wait(30.0)


def test_a_vehicle_that_could_not_be_enabled_still_stands_before_the_station(world: VirtualCell, devices: Devices):
    tip = from_ur(devices.arm.state().flange) * from_parts((0.0, 0.0, 0.145))
    table = block("table", BASE, tip.translation - [0.3, 0.3, 0.2], tip.translation + np.array([0.3, 0.3, -0.03]))
    devices.interlocks.stand_before([table])
    world.world.vehicle.fault("vehicle.emergency_stop", world.clock.now())
    with pytest.raises(DeviceFault, match="emergency stop"):
        devices.vehicle.enable()
    assert devices.interlocks.situation.station == (table,)
    down = shifted(devices, 0.0, 0.0, -0.05)
    refused("way_clear", lambda: devices.arm.move_linear(down, 0.05, 0.5), "claw and table")


def test_the_part_counts_only_while_the_claw_holds_it(devices: Devices):
    arm, interlocks = devices.arm, devices.interlocks
    post = from_ur(arm.state().flange) * from_parts((0.0, 0.0, 0.2))
    interlocks.stand_before([block("post", BASE, post.translation - 0.02, post.translation + 0.02)])
    interlocks.carry([block("part", FLANGE, (-0.2, -0.01, 0.145), (0.2, 0.01, 0.165))])
    up_and_down = [arm.state().joints, arm.state().joints + np.array([0.0, 0.0, 0.06, 0.0, 0.0, 0.0])]
    refused("way_clear", lambda: arm.follow(np.array([0.0, 9.0]), np.array(up_and_down)), "part")
    with interlocks.lifted(["claw_at_contact"]):
        devices.claw.release()
    assert interlocks.situation.part == ()


def test_what_is_near_at_the_beginning_may_part_but_not_come_nearer(devices: Devices):
    arm = devices.arm
    tip = (from_ur(arm.state().flange) * from_parts((0.0, 0.0, 0.145))).translation
    devices.interlocks.stand_before([block("shelf", BASE, tip - [0.3, 0.3, 0.1], tip + np.array([0.3, 0.3, -0.001]))])
    refused("way_clear", lambda: arm.move_linear(shifted(devices, 0, 0, -0.0006), 0.01, 0.5), "claw and shelf")
    up = shifted(devices, 0.0, 0.0, 0.01)
    here = arm.state().joints
    arm.move_linear(up, 0.02, 0.5).wait(30.0)
    higher = arm.state().joints
    refused("way_clear", lambda: arm.move_joints(here, 0.2, 0.5), "claw and shelf")
    arm.bare.move_joints(here, 0.2, 0.5).wait(30.0)
    up_and_down = np.array([here, higher, here])
    refused("way_clear", lambda: arm.follow(np.array([0.0, 3.0, 6.0]), up_and_down), "claw and shelf")
    arm.follow(np.array([0.0, 3.0]), up_and_down[:2]).wait(30.0)


@pytest.mark.parametrize(("row", "column", "by"), [(1, 0, 0.06e-3), (4, 3, 0.2e-3)], ids=["length", "zero"])
def test_an_arm_that_was_calibrated_anew_under_the_cell_does_not_move(
    world: VirtualCell, devices: Devices, row: int, column: int, by: float
):
    devices.arm.move_joints(HOME + 0.01, 0.5, 1.0).wait(60.0)
    before = devices.arm.state()
    table = world.world.arm.params.dh.copy()
    table[row, column] += by
    world.world.arm.kinematics = world.world.arm.drive.kinematics = Kinematics(table)
    for begin in (
        lambda: devices.arm.move_joints(HOME, 0.5, 1.0),
        lambda: devices.arm.move_linear(before.flange, 0.05, 0.5),
        lambda: devices.arm.follow(np.array([0.0, 1.0]), np.stack([before.joints, HOME])),
    ):
        refused("same_kinematics", begin, "mm and", "mrad away", "port 30001")
    assert np.array_equal(devices.arm.state().joints, before.joints)


def test_an_arm_without_power_is_refused_by_its_driver_which_says_how_it_goes_on(world: VirtualCell, devices: Devices):
    arm = world.world.arm
    table = arm.params.dh.copy()
    table[1, 0] += 1e-3
    arm.kinematics = arm.drive.kinematics = Kinematics(table)
    arm.power = Power.OFF
    assert not devices.arm.state().controlled
    with pytest.raises(DeviceFault, match="power is off") as caught:
        devices.arm.move_joints(HOME, 0.5, 1.0)
    assert caught.value.code == "arm.not_powered"
    arm.power = Power.RUNNING
    refused("same_kinematics", lambda: devices.arm.move_joints(HOME, 0.5, 1.0))
