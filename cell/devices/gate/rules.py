"""The interlocks as a table: which commands each is asked for, what has to hold, and how that is looked up.

`python -m cell.devices.gate.rules` prints the table of docs/reference/interlocks.md; a test keeps it current. A way is
checked against arm, tool, vehicle, deck and obstacles, and against part and station once a run has told of them.
"""

import math
import threading
from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin

from cell.config.cell_config import CellConfig, deck_plates, mounted, vehicle_obstacles
from cell.devices.gate.gated import UNATTENDED_S, GuardedMotion
from cell.devices.gate.interlocks import PURPOSES, DeviceCommand, Rule, Situation
from cell.measure.geometry.poses import from_ur
from cell.motion.collision import (
    TOUCHES,
    Body,
    CollisionModel,
    Pair,
    arm_bodies,
    first_touch,
    tool_bodies,
    vehicle_bodies,
)
from cell.motion.kinematics import Joints, arm_kinematics
from cell.motion.trajectory import PointSpeed, carried_points
from drivers.errors import DeadlineError
from drivers.interfaces import Arm, ArmState, LinkTable, Vector, Vehicle, VehicleState

TIMEOUT_S = 1.0
"""How old a reading may be that a rule rests on: what it asks about does not change by itself."""
STILL = 0.005
"""Speed in m/s and rad/s below which the vehicle stands: its feedback has steps of 0.001."""
LATE_S = 0.5
"""How long a reading of the vehicle is waited for, on the wall; and how old one of the arm may be, by which the vehicle
is driven on: such a command must not wait, because the velocity before it is kept alive meanwhile."""
TURNING = 0.05
"""Speed of a joint in rad/s from which the arm moves by itself: the vehicle shakes it a little as it drives."""
MOVED_RAD = 0.005
"""Angle of a joint by which the arm may be off where contact ended: some mm at its reach."""
POSTURE_RAD = math.radians(2.0)
SAME_M, SAME_RAD = 0.05e-3, 0.1e-3
"""How far the flange may be reported from where the cell has it: both are computed from the same angles."""
LOOK_M, LOOK_RAD = 0.03, math.radians(3.0)
"""How near the arm has to be to a transport pose. A looking pose is reckoned from the camera's mounting as configured
or as calibrated, which differ."""

MOVES = ("arm.move_joints", "arm.move_linear", "arm.follow")


def _parked(now: Situation, command: DeviceCommand) -> str | None:
    if now.vehicle is None:
        return "the vehicle is not connected, so nobody knows whether it is parked. Open the cell with it"
    state = _newest(now, now.vehicle)
    if not (abs(state.speed) <= STILL and abs(state.yaw_rate) <= STILL):
        return f"the vehicle drives at {state.speed:.3f} m/s, {state.yaw_rate:.3f} rad/s. Call vehicle.brake() first"
    if state.braked is None:
        return "the vehicle's brake is not known to be locked. Call vehicle.recover() first"
    return None if state.braked else "the vehicle's brake is open. Call vehicle.brake() first"


def _newest(now: Situation, vehicle: Vehicle) -> VehicleState:
    """The vehicle's feedback. One that is late is waited for; of a braked vehicle that is not silent it will do."""
    clock = now.clock
    until = clock.now() + LATE_S * max(1.0, clock.rate)
    while True:
        try:
            return vehicle.state(TIMEOUT_S)
        except DeadlineError:
            if clock.now() < until:
                clock.sleep(0.02)
                continue
            state = vehicle.state(math.inf)
            if not state.braked:
                raise
            vehicle.check()
            return state


def _arm_now(now: Situation, arm: Arm) -> ArmState:
    """The arm's newest state, without waiting for a newer one; `DeadlineError` when it is too old."""
    state = arm.state(math.inf)
    age, allowed = now.clock.now() - state.stamp, LATE_S * max(1.0, now.clock.rate)
    if not age <= allowed:
        raise DeadlineError(arm.name, f"its newest state is {age:.2f} s old, allowed {allowed:.2f} s. See its link")
    return state


def _moves(now: Situation, state: ArmState) -> str | None:
    if (now.last is not None and not now.last.done) or not np.abs(state.joint_speeds).max() <= TURNING:
        return "the arm moves. Wait for its motion first"
    return None


def _at_rest(now: Situation, command: DeviceCommand) -> str | None:
    return None if now.arm is None else _moves(now, now.arm.state(TIMEOUT_S))


def _still(now: Situation, command: DeviceCommand) -> str | None:
    if (against := _at_rest(now, command)) is not None:
        return against
    if now.last is not None and now.last.contact:
        return "the arm's last motion ended at contact, and it may still touch something. Move it away first"
    return None


def _stowed(now: Situation, command: DeviceCommand) -> str | None:
    if not any(command.arguments.values()):
        return None
    if now.arm is None:
        return "the arm is not connected, so nobody knows how it stands. Open the cell with it"
    state = _arm_now(now, now.arm)
    if (against := _moves(now, state)) is not None:
        return against
    off = {name: float(np.abs(state.joints - posture).max()) for name, posture in now.postures.items()}
    if min(off.values()) <= POSTURE_RAD:
        return None
    flange = now.forward(state.joints)
    for look in now.looks.values():
        apart = look.inverse() * flange
        if np.linalg.norm(apart.translation) <= LOOK_M and np.linalg.norm(pin.log3(apart.rotation)) <= LOOK_RAD:
            return None
    nearest = min(off, key=lambda name: off[name])
    poses = ", ".join([*now.postures, *now.looks])
    return (
        f"the arm stands in no transport pose ({poses}): {math.degrees(off[nearest]):.1f} deg from {nearest}, allowed "
        f"{math.degrees(POSTURE_RAD):.0f} deg. Bring it there, with `cell home arm`"
    )


def _dark(now: Situation, command: DeviceCommand) -> str | None:
    driving = command.name == "drive"
    if now.laser is None or (driving and not any(command.arguments.values())):
        return None
    output = next((index for index, owner in now.outputs.items() if owner == "laser"), None)
    if driving and output is not None and now.arm is not None:
        lit = bool(_arm_now(now, now.arm).digital_outputs >> output & 1)
    else:
        lit = now.laser.is_on
    return "the laser is on. Switch it off first" if lit else None


def _purpose(now: Situation, command: DeviceCommand) -> str | None:
    if now.purpose is None:
        return f"nobody said what the laser is lit for. Light it inside interlocks.purpose(…): {', '.join(PURPOSES)}"
    return None


def _contact(now: Situation, command: DeviceCommand) -> str | None:
    if now.claw is not None and not now.claw.holding:
        return None
    motion = now.last
    if isinstance(motion, GuardedMotion) and motion.done and motion.contact:
        if now.arm is None or motion.rest is None:
            return "nobody has seen where the arm stood when its motion ended at contact. Wait for that motion's end"
        moved = float(np.abs(now.arm.state().joints - motion.rest).max())
        if moved <= MOVED_RAD:
            return None
        return (
            f"a joint of the arm was moved by {math.degrees(moved):.2f} deg since its motion ended at contact, allowed "
            f"{math.degrees(MOVED_RAD):.2f} deg, so the part would fall. Set it down with a force limit again"
        )
    return (
        "the claw holds a part, and the arm's last motion did not end at contact, so the part would fall. Set it down "
        'with a force limit first; a person who holds it lifts this with maintenance(reason, lift=["claw_at_contact"])'
    )


def _calibrated(now: Situation, command: DeviceCommand) -> str | None:
    if str(command) == "arm.follow" and command.arguments["force_limit"] is None:
        return None
    if now.calibrated is None:
        return "no calibration is in use. Do it in a job, or calibrate the cell with `cell calibrate`"
    if now.calibrated != now.configuration:
        return (
            f"the calibration in use was made under configuration {now.calibrated}, this cell is {now.configuration}. "
            "Calibrate it with `cell calibrate`"
        )
    return None


def _clear(now: Situation, command: DeviceCommand) -> str | None:
    if now.arm is None:
        return None
    pairs = now.clear(now.arm.state(TIMEOUT_S).joints, command, (*now.held, *now.station))
    if not pairs:
        return None
    return f"{', '.join(f'{a} and {b}' for a, b in pairs)} would collide on the way. Go another way, or plan it"


def _kinematics(now: Situation, command: DeviceCommand) -> str | None:
    if now.arm is None:
        return None
    state = now.arm.state(TIMEOUT_S)
    if _moves(now, state) is not None:
        return None
    if not state.controlled:
        # Another tool may be set while no program runs. The device itself refuses then, and says how it goes on.
        return None
    apart = now.forward(state.joints).actInv(from_ur(state.flange))
    way, turn = np.linalg.norm(apart.translation), np.linalg.norm(pin.log3(apart.rotation))
    if way <= SAME_M and turn <= SAME_RAD:
        return None
    return (
        f"the arm reports its flange {1e3 * way:.3f} mm and {1e3 * turn:.3f} mrad away from where this cell's model of "
        f"it has it (allowed {1e3 * SAME_M:g} mm, {1e3 * SAME_RAD:g} mrad), so it would go elsewhere than planned. See "
        "that nobody has set another tool at the pendant, that arm.address is this arm's and that the controller's "
        "port 30001 can be read; then connect anew, and calibrate the cell if the arm was exchanged"
    )


def _own_switch(now: Situation, command: DeviceCommand) -> str | None:
    index, value = command.arguments["index"], command.arguments["value"]
    owner = now.outputs.get(index)
    if owner is None or (owner == "laser" and not value):
        return None
    return f"output {index} is the {owner}'s. Use the {owner} itself, which has its own interlocks"


RULES = (
    Rule("vehicle_parked", (*MOVES, "laser.lit"), "the vehicle stands and its brake is locked", _parked),
    Rule(
        "arm_stowed", ("vehicle.drive",),
        "the arm is at rest in a transport pose: HOME, over the fine board, or a job's looking pose", _stowed,
    ),
    Rule(
        "arm_still", ("vehicle.enable",),
        "the arm, where it is connected, is at rest, and its last motion did not end at contact", _still,
    ),
    Rule("laser_off_to_drive", ("vehicle.enable", "vehicle.drive"), "the laser is off", _dark),
    Rule("laser_purpose", ("laser.lit",), f"it was said what for: {', '.join(PURPOSES)}", _purpose),
    Rule("claw_at_rest", ("claw.grip", "claw.release"), "the arm, where it is connected, is at rest", _at_rest),
    Rule(
        "claw_at_contact", ("claw.release",),
        "the arm still stands where its last motion ended at contact, or the claw shows no part; else a person's word",
        _contact,
    ),
    Rule(
        "calibration_fits", ("rail.sweep", "arm.follow"),
        "a calibration of this cell as configured is in use (of `arm.follow`: with a force limit)", _calibrated,
    ),
    Rule(
        "same_kinematics", MOVES,
        "the arm at rest reports its flange where the cell's model of it has it, to 0.05 mm and 0.1 mrad",
        _kinematics, liftable=False,
    ),
    Rule(
        "way_clear", MOVES,
        "arm, tool, vehicle, boards on the deck, and part and station where a run has told of them, stay apart all the "
        "way; what is near at the beginning may part, but not come nearer", _clear,
    ),
    Rule(
        "own_switch", ("arm.set_digital_output",),
        "the output belongs to no other device; the laser's may be switched off", _own_switch,
    ),
    Rule(
        "laser_attended", ("laser.lit",),
        f"its owner renews it at least every {UNATTENDED_S:.0f} s on the wall; else it goes off by itself",
        None, liftable=False,
    ),
    Rule(
        "after_a_stop",
        (*MOVES, "arm.recover", "arm.zero_force", "arm.set_payload", "arm.set_digital_output", "rail.home",
         "rail.move_to", "rail.nudge", "rail.sweep", "vehicle.enable", "vehicle.recover", "vehicle.drive", "laser.lit",
         "claw.grip", "claw.release"),
        "it belongs to a run that began later, or a person has said `Cell.clear_stop(by)`; work that was going on "
        "begins nothing more; the laser's output may be switched off, and one that a commissioning is trying",
        None, liftable=False,
    ),
)  # fmt: skip


def markdown() -> str:
    """The table for people."""
    lines = ["| interlock | commands | condition | liftable |", "|---|---|---|---|"]
    for rule in RULES:
        commands = ", ".join(f"`{name}`" for name in rule.commands)
        lines.append(f"| `{rule.name}` | {commands} | {rule.condition} | {'yes' if rule.liftable else 'no'} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(markdown())


MARGIN_M = 0.002
"""Less than the planner keeps, so that what it finds free is not refused for a rounding."""
LINE_STEP_M, LINE_STEP_RAD = 0.01, 0.03


class Ways:
    """The ways of an arm whose controller told `table`, or none, through its own cell."""

    def __init__(self, config: CellConfig, table: LinkTable | None = None) -> None:
        self._config = config
        self._obstacles = vehicle_obstacles(config.obstacle)
        self._one_at_a_time = threading.Lock()
        self.kinematics = arm_kinematics(config.arm.model, table)
        # One of its own: where the arm stands is asked while a way is reckoned.
        self._looking = threading.Lock()
        self._standing = arm_kinematics(config.arm.model, table)
        self._known: tuple[tuple[Body, ...], CollisionModel] | None = None

    def _among(self, others: tuple[Body, ...]) -> CollisionModel:
        if self._known is None or self._known[0] != others:
            tool = tool_bodies(None, None, mounted(self._config))
            own = [*arm_bodies(self._config.arm.model), *tool, *vehicle_bodies(deck_plates(self._config))]
            self._known = others, CollisionModel(self.kinematics, [*own, *self._obstacles, *others], MARGIN_M)
        return self._known[1]

    def forward(self, joints: Vector) -> pin.SE3:
        """base_from_flange at joint angles (6,) in rad; callable from any thread."""
        with self._looking:
            return self._standing.fk(joints)

    def clear(self, start: Vector, command: DeviceCommand, others: Sequence[Body] = ()) -> list[Pair]:
        """The pairs that come closer than 2 mm on the way from `start`, (6,) rad, with these `others` about.

        What is closer at the beginning may part, but not come nearer. With a force limit the part may be set down.
        Raises `Unreachable` when the arm cannot follow a straight line.
        """
        with self._one_at_a_time:
            allowed = () if command.arguments.get("force_limit") is None else TOUCHES
            way = np.array([start, *self._way(start, command)])
            touch = first_touch(self._among(tuple(others)), way, allowed, opening=True)
            return [] if touch is None else touch.pairs

    def slowed(self, start: Vector, goal: Vector, speed: float, carried: Sequence[Body] = ()) -> float:
        """`speed`, rad/s of the joint that turns most from `start` to `goal` (6,), or less: as much as keeps every
        point of the tool, and of what is `carried`, within `arm.max_tool_speed`. One out of range is left to the arm.
        """
        way = float(np.abs(np.asarray(goal) - start).max())
        if not 0.0 < speed <= self._config.arm.max_joint_speed or way == 0.0:
            return speed
        with self._one_at_a_time:
            points = carried_points(self._among(tuple(carried)).bodies)
            bound = PointSpeed(self.kinematics, points, self._config.arm.max_tool_speed)
            return min(speed, way * bound.fraction_speed(np.asarray(start), np.asarray(goal)))

    def _way(self, start: Joints, command: DeviceCommand) -> Iterator[Joints]:
        arguments = command.arguments
        match command.name:
            case "move_joints":
                yield np.asarray(arguments["joints"])
            case "move_linear":
                yield from self._line(start, from_ur(arguments["flange"]))
            case _:
                yield from np.asarray(arguments["joints"])

    def _line(self, joints: Joints, goal: pin.SE3) -> Iterator[Joints]:
        begin = self.kinematics.fk(joints)
        apart = begin.inverse() * goal
        length, turn = np.linalg.norm(apart.translation), np.linalg.norm(pin.log3(apart.rotation))
        count = max(1, int(np.ceil(max(length / LINE_STEP_M, turn / LINE_STEP_RAD))))
        for k in range(1, count + 1):
            pose = pin.SE3(begin.rotation @ pin.exp3(pin.log3(apart.rotation) * (k / count)), np.zeros(3))
            pose.translation = begin.translation + (goal.translation - begin.translation) * (k / count)
            joints = self.kinematics.track(pose, joints)
            yield joints
